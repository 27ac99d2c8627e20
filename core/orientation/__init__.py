"""A camera that moved: its orientation against the other from offsets across epipolar lines, and its repair."""

from core.orientation.change import changed, changes_between
from core.orientation.consequence import Consequence, consequence_of
from core.orientation.estimate import OrientationEstimate, estimate_change
from core.orientation.finding import OffsetFinding, judge_offsets
from core.orientation.repair import Repair, RepairLimits, repair_orientation

__all__ = [
    "Consequence",
    "OffsetFinding",
    "OrientationEstimate",
    "Repair",
    "RepairLimits",
    "changed",
    "changes_between",
    "consequence_of",
    "estimate_change",
    "judge_offsets",
    "repair_orientation",
]
