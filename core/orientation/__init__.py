"""A camera that moved: its orientation against the other from offsets across epipolar lines, and its repair."""

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
