"""Camera motion seen in a step's epipolar offsets: an entry of ``summary.json`` and of the API."""

from __future__ import annotations

from dataclasses import dataclass

from stereorig.core.orientation import OffsetJudgement

#: advice to the user about a camera that moved
MOVED_REMEDY = "Repair the calibration from steps taken since (stereorig calibration repair), or calibrate again."


@dataclass(frozen=True)
class MotionCheck:
    """Result of the check that neither camera moved.

    Attributes
    ----------
    camera_moved
        True if one moved since the calibration, the reference or the step before; False if none of these is seen; None
        if that cannot be decided.
    text
        The finding in a sentence; of several motions the last one seen.
    calibration, reference, last_step
        The findings; None if there is nothing to compare the step with.
    """

    camera_moved: bool | None
    text: str
    calibration: OffsetJudgement | None
    reference: OffsetJudgement | None
    last_step: OffsetJudgement | None

    @staticmethod
    def of(
        calibration: OffsetJudgement | None, reference: OffsetJudgement | None, last_step: OffsetJudgement | None
    ) -> MotionCheck | None:
        """Put the findings of a step together; None without any."""
        found = [f for f in (last_step, reference, calibration) if f is not None]
        if not found:
            return None
        moving = [f for f in found if f.camera_moved]
        unknown = [f for f in found if f.camera_moved is None]
        moved = True if moving else None if unknown else False
        told = (moving or unknown or found)[0]
        return MotionCheck(moved, told.text, calibration, reference, last_step)

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        named = {"calibration": self.calibration, "reference": self.reference, "last_step": self.last_step}
        return {
            "camera_moved": self.camera_moved,
            "text": self.text,
            **{name: None if f is None else f.document() for name, f in named.items()},
        }
