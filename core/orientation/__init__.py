"""A camera that moved: its orientation against the other from offsets across epipolar lines, and its repair."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.orientation.change import changed, changes_between
    from stereorig.core.orientation.consequence import Consequence, consequence_of
    from stereorig.core.orientation.estimate import OrientationEstimate, estimate_change
    from stereorig.core.orientation.finding import OffsetJudgement, judge_offsets
    from stereorig.core.orientation.repair import RepairedPair, RepairLimits, repair_orientation

__all__ = [
    "Consequence",
    "OffsetJudgement",
    "OrientationEstimate",
    "RepairLimits",
    "RepairedPair",
    "changed",
    "changes_between",
    "consequence_of",
    "estimate_change",
    "judge_offsets",
    "repair_orientation",
]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "change": ("changed", "changes_between"),
        "consequence": ("Consequence", "consequence_of"),
        "estimate": ("OrientationEstimate", "estimate_change"),
        "finding": ("OffsetJudgement", "judge_offsets"),
        "repair": ("RepairedPair", "RepairLimits", "repair_orientation"),
    },
)
