"""A guided acquisition of free poses: what the views show so far, and which view would help most."""

from core.calibration.guide.coverage import Coverage, coverage_of
from core.calibration.guide.estimate import Estimate, estimate
from core.calibration.guide.guide import Guidance, GuideOptions, guide
from core.calibration.guide.proposals import Proposal
from core.calibration.guide.sight import Likeness, at_rest, most_alike

__all__ = [
    "Coverage",
    "Estimate",
    "Guidance",
    "GuideOptions",
    "Likeness",
    "Proposal",
    "at_rest",
    "coverage_of",
    "estimate",
    "guide",
    "most_alike",
]
