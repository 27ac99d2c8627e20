"""Matching of one patch: shape from two images, shape and motion from four."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.matching.fit import MotionFit, ShapeFit, fit_motion, fit_shape, no_motion
    from stereorig.core.matching.image import ImageData, prepare
    from stereorig.core.matching.options import MatchOptions

__all__ = ["ImageData", "MatchOptions", "MotionFit", "ShapeFit", "fit_motion", "fit_shape", "no_motion", "prepare"]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "fit": ("MotionFit", "ShapeFit", "fit_motion", "fit_shape", "no_motion"),
        "image": ("ImageData", "prepare"),
        "options": ("MatchOptions",),
    },
)
