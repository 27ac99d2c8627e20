"""Settings of the measurement of a field."""

from __future__ import annotations

from dataclasses import dataclass, field

from core.errors import InputError
from core.field.checks.validity import ValidityOptions
from core.field.prefilter import check_prefilter
from core.field.region.region import check_subset
from core.matching.blur import Blur
from core.matching.options import MatchOptions, Patch
from core.noise import NoiseModel
from core.settings import (
    DEFAULT_INTERPOLATION,
    DEFAULT_PATCH,
    DEFAULT_SPLIT_STEP,
    PATCH_SETTINGS,
    SPLIT_STEP_FROM,
    SUBSET_PX,
    AnalysisSettings,
    Interpolation,
    PatchSetting,
)


@dataclass(frozen=True, kw_only=True)
class MeasureOptions:
    """Settings of the measurement of a field.

    Attributes
    ----------
    subset_px
        Width of the square subset.
    patch
        ``stretch`` (default) or the paper's ``rigid``: plane patches. ``curved``: second-order surface and
        displacement, for about twice the noise. ``auto``: plane (stretch) or curved, whichever has the smaller total
        error on the field; decided separately for shape and motion. A sequence that changed to curved patches keeps
        them.
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
        Noise models of camera 1 and camera 2 (:func:`core.noise.measure_noise`): they weigh the pixels and give the
        covariances. None: noise from the residuals of each match, all pixels alike.
    keep_rejected
        Keep, apart, the numbers of points that a check rejects.
    split_from
        Usable points from which a field is grown in two passes, see :mod:`core.field.growth.coarse_first`, and its
        points may be shared out.
    """

    subset_px: int = SUBSET_PX.default
    patch: PatchSetting = DEFAULT_PATCH
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    min_zncc: float = 0.6
    validity: ValidityOptions = field(default_factory=ValidityOptions)
    prefilter_px: float = 0.0
    noise: tuple[NoiseModel | None, NoiseModel | None] = (None, None)
    keep_rejected: bool = False
    split_from: float = SPLIT_STEP_FROM[DEFAULT_SPLIT_STEP]

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
            split_from=SPLIT_STEP_FROM[settings.split_step],
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
            max_sigma_px=self.validity.max_sigma_px,
        )
