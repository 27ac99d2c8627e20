"""Record of the patch that a field was measured with.

Separate from the choice itself, so that files can be read and written without loading the matching.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from stereorig.core.settings import PatchSetting

UsedPatch = Literal["plane", "rigid", "affine", "quadratic"]


@dataclass(frozen=True, kw_only=True)
class PatchChoice:
    """The patch of a field, and the reason for it.

    Attributes
    ----------
    patch
        Patch that the field was measured with: ``plane`` (shape), ``affine`` or ``rigid`` (motion), or ``quadratic``.
    asked
        The setting: ``auto``, ``affine``, ``rigid`` or ``quadratic``.
    reason
        A sentence for the user.
    sample
        Number of points fitted both ways; 0 if the field's own curvature decided.
    plane_error_mm
        Bias of plane patches because of curvature, rms, less noise; of the position for a shape, of the displacement
        for a motion. None if it is not known, as the next two.
    plane_noise_mm, quadratic_noise_mm
        Standard deviation of the same from image noise, rms, with plane and with quadratic patches.
    quadratic_advised
        True if plane patches were asked for and quadratic ones would have the smaller total error.
    taken_off_mm
        Bias that was subtracted from the displacements of plane patches, rms; None if none was.
    width_px
        Root mean square of the subsets' widths if some are wider than asked for; else None.
    kept
        True if the choice was made in an earlier step of the sequence and kept.
    """

    patch: UsedPatch
    asked: PatchSetting
    reason: str
    sample: int = 0
    plane_error_mm: float | None = None
    plane_noise_mm: float | None = None
    quadratic_noise_mm: float | None = None
    quadratic_advised: bool = False
    taken_off_mm: float | None = None
    width_px: float | None = None
    kept: bool = False

    def document(self) -> dict[str, Any]:
        """Return the choice as it is written to files."""
        return asdict(self)

    @staticmethod
    def from_document(document: dict[str, Any]) -> PatchChoice:
        """Return the choice from :meth:`document`; names of later versions are left out."""
        known = PatchChoice.__dataclass_fields__
        return PatchChoice(**{name: value for name, value in document.items() if name in known})

    def for_next_step(self) -> PatchChoice:
        """Return the same choice as a later step of the sequence keeps it."""
        if self.kept:
            return self
        return replace(self, kept=True, reason=f"kept from an earlier step, so that steps compare: {self.reason}")


def asked_for(patch: UsedPatch, asked: PatchSetting) -> PatchChoice:
    """Return the choice that the user made."""
    return PatchChoice(patch=patch, asked=asked, reason=f"{patch}: asked for")


def format_length(mm: float) -> str:
    """Return a length as text with its unit, two digits."""
    return f"{1e3 * mm:.2g} um" if mm < 0.1 else f"{mm:.2g} mm"
