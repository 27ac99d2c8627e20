"""What a step's epipolar offsets say about the cameras: an entry of ``summary.json`` and of the API."""

from __future__ import annotations

from dataclasses import dataclass

from core.orientation import OffsetFinding

#: what a user can do about a camera that moved
MOVED_REMEDY = "Repair the calibration from steps taken since (stereorig calibration repair), or calibrate again."


@dataclass(frozen=True)
class CameraMotion:
    """Whether a camera moved.

    Attributes
    ----------
    camera_moved
        True if one moved since the calibration, the reference or the step before; False if none of these is seen; None
        where that cannot be told.
    text
        The finding in a sentence: that of the motion seen last.
    calibration, reference, last_step
        The findings; None where there is nothing to hold the step against.
    """

    camera_moved: bool | None
    text: str
    calibration: OffsetFinding | None
    reference: OffsetFinding | None
    last_step: OffsetFinding | None

    @staticmethod
    def of(
        calibration: OffsetFinding | None, reference: OffsetFinding | None, last_step: OffsetFinding | None
    ) -> CameraMotion | None:
        """Put the findings of a step together; None without any."""
        found = [f for f in (last_step, reference, calibration) if f is not None]
        if not found:
            return None
        moving = [f for f in found if f.camera_moved]
        unknown = [f for f in found if f.camera_moved is None]
        moved = True if moving else None if unknown else False
        told = (moving or unknown or found)[0]
        return CameraMotion(moved, told.text, calibration, reference, last_step)

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        named = {"calibration": self.calibration, "reference": self.reference, "last_step": self.last_step}
        return {
            "camera_moved": self.camera_moved,
            "text": self.text,
            **{name: None if f is None else f.document() for name, f in named.items()},
        }
