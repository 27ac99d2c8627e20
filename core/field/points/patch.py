"""What a field says of the patch that it was measured with.

Apart from the choice itself, so that files can be read and written without loading the matching.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from core.settings import PatchSetting

UsedPatch = Literal["plane", "rigid", "stretch", "curved"]


@dataclass(frozen=True, kw_only=True)
class PatchChoice:
    """The patch of a field, and why.

    Attributes
    ----------
    patch
        What the field was measured with: ``plane`` (shape) or ``stretch``, ``rigid`` (motion), or ``curved``.
    asked
        The setting: one of these, or ``auto``.
    reason
        A sentence for the user.
    sample
        How many points were fitted both ways; 0 where the field's own curvature told enough.
    plane_error_mm
        What plane patches err by because of curvature, rms, noise taken off; of the position for a shape, of the
        displacement for a motion. None where it is not known, as the next two.
    plane_noise_mm, curved_noise_mm
        Standard deviation of the same from image noise, rms, with plane and with curved patches.
    curved_advised
        True if plane patches were asked for and curved ones would err less.
    kept
        True if the choice was made in an earlier step of the sequence and kept.
    """

    patch: UsedPatch
    asked: PatchSetting
    reason: str
    sample: int = 0
    plane_error_mm: float | None = None
    plane_noise_mm: float | None = None
    curved_noise_mm: float | None = None
    curved_advised: bool = False
    kept: bool = False

    def document(self) -> dict[str, Any]:
        """Return the choice in the words of a file."""
        return asdict(self)

    @staticmethod
    def from_document(document: dict[str, Any]) -> PatchChoice:
        """Return what :meth:`document` wrote; names of later versions are left out."""
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
    """Return a length in words, two digits."""
    return f"{1e3 * mm:.2g} um" if mm < 0.1 else f"{mm:.2g} mm"
