"""Matching of one patch: shape from two images, shape and motion from four."""

from stereorig.core.matching.fit import MotionFit, ShapeFit, fit_motion, fit_shape, no_motion
from stereorig.core.matching.image import ImageData, prepare
from stereorig.core.matching.options import MatchOptions

__all__ = ["ImageData", "MatchOptions", "MotionFit", "ShapeFit", "fit_motion", "fit_shape", "no_motion", "prepare"]
