"""Settings of the measurement of a field."""

from __future__ import annotations

from dataclasses import dataclass, field

from stereorig.core.errors import InputError
from stereorig.core.field.checks.validity import ValidityOptions
from stereorig.core.field.region.region import check_subset
from stereorig.core.matching.blur import Blur
from stereorig.core.matching.options import MatchOptions, Patch
from stereorig.core.noise import NoiseModel
from stereorig.core.settings import (
    DEFAULT_INTERPOLATION,
    DEFAULT_PATCH,
    PATCH_SETTINGS,
    PREFILTER_OF_SUBSET,
    SUBSET_PX,
    AnalysisSettings,
    Interpolation,
    PatchSetting,
    single_sigma_px,
)


@dataclass(frozen=True, kw_only=True)
class MeasureOptions:
    """Settings of the measurement of a field.

    Attributes
    ----------
    subset_px
        Width of the square subset.
    patch
        ``auto`` (default): ``affine`` or ``quadratic``, the one with the smaller total error on the field; decided
        separately for shape and motion. A sequence that changed to quadratic patches keeps them. ``affine``, or the
        paper's ``rigid``: plane patches. ``quadratic``: second-order surface and displacement, for about twice the
        noise.
    interpolation
        ``quintic`` (default), or ``cubic`` for speed: on sharp speckle it adds a bias of a few thousandths of a pixel.
    min_zncc
        Correlation below which no comparison is a match. Above it the field's own statistics decide.
    validity
        Limits of the validity checks.
    prefilter_px
        Standard deviation of a Gaussian that all images are blurred with before they are compared, px; 0: none. At most
        a quarter of the subset. It removes the interpolation bias of sharp texture and increases the random error.
    noise
        Noise models of camera 1 and camera 2 (:func:`stereorig.core.noise.measure_noise`): they weigh the pixels and
        give the covariances. None: noise from the residuals of each match, all pixels alike.
    keep_rejected
        Keep the numbers of points that a check rejects, in arrays of their own.
    coarse_from
        Usable points from which a field is grown in two passes, see :mod:`stereorig.core.field.growth.coarse_first`.
    """

    subset_px: int = SUBSET_PX.default
    patch: PatchSetting = DEFAULT_PATCH
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    min_zncc: float = 0.6
    validity: ValidityOptions = field(default_factory=ValidityOptions)
    prefilter_px: float = 0.0
    noise: tuple[NoiseModel | None, NoiseModel | None] = (None, None)
    keep_rejected: bool = False
    coarse_from: int = 20_000

    def __post_init__(self) -> None:
        check_subset(self.subset_px)
        check_prefilter(self.prefilter_px, self.subset_px)
        if not 0.0 < self.min_zncc < 1.0:
            raise InputError(f"min_zncc is {self.min_zncc}, it must lie in 0 to 1.", code="option_out_of_range")
        if self.patch not in PATCH_SETTINGS:
            raise InputError(
                f"patch is {self.patch!r}, it must be one of {', '.join(PATCH_SETTINGS)}.", code="option_out_of_range"
            )
        self.match_options()

    @staticmethod
    def of(
        settings: AnalysisSettings, noise: tuple[NoiseModel | None, NoiseModel | None] = (None, None)
    ) -> MeasureOptions:
        """Return the options of an analysis' settings."""
        return MeasureOptions(
            subset_px=settings.subset_px,
            patch=settings.patch,
            interpolation=settings.interpolation,
            prefilter_px=settings.prefilter_px,
            noise=noise,
            validity=ValidityOptions(max_sigma_px=settings.max_sigma_px),
            keep_rejected=settings.keep_rejected,
        )

    @property
    def blur(self) -> Blur | None:
        """The prefilter; None without one."""
        return Blur(self.prefilter_px) if self.prefilter_px > 0.0 else None

    def match_options(self) -> MatchOptions:
        """Return the point-level options, with plane patches: curved ones start from their results."""
        patch: Patch = "rigid" if self.patch == "rigid" else "affine"
        return MatchOptions(
            subset_px=self.subset_px,
            patch=patch,
            interpolation=self.interpolation,
            max_sigma_px=single_sigma_px(self.validity.max_sigma_px),
        )


# Bounds of the Gaussian prefilter of all images of a measurement.
#
# All images of all steps are blurred alike before gradients and splines are made of them; seeds are searched for in the
# images as they are. The effect of the blur on noise and covariance: ``stereorig.core.matching.blur``.


def check_prefilter(prefilter_px: float, subset_px: int) -> None:
    """Raise an error for a standard deviation that is negative, no number, or above a quarter of the subset.

    Raises
    ------
    InputError
        ``prefilter_invalid``.
    """
    if isinstance(prefilter_px, bool) or not 0.0 <= prefilter_px <= PREFILTER_OF_SUBSET * subset_px:
        raise InputError(
            f"the prefilter is {prefilter_px} px; it must lie in 0 (off) to a quarter of the subset, "
            f"{PREFILTER_OF_SUBSET * subset_px:g} px.",
            code="prefilter_invalid",
            remedy="Give 0.5 to 1, for example, or 0 for none; against noise a larger subset does more.",
        )
