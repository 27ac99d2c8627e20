"""Guided acquisition of free poses: the information of the views so far, and the next view that would help most."""

from stereorig.core.calibration.guide.coverage import ViewCoverage, coverage_of
from stereorig.core.calibration.guide.estimate import Estimate, estimate
from stereorig.core.calibration.guide.guide import Guidance, GuideOptions, guide
from stereorig.core.calibration.guide.proposals import Proposal
from stereorig.core.calibration.guide.sight import Likeness, at_rest, most_alike

__all__ = [
    "Estimate",
    "Guidance",
    "GuideOptions",
    "Likeness",
    "Proposal",
    "ViewCoverage",
    "at_rest",
    "coverage_of",
    "estimate",
    "guide",
    "most_alike",
]
