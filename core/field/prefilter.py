"""Bounds of the Gaussian prefilter of all images of a measurement.

All images of all steps are blurred alike before gradients and splines are made of them; seeds are searched for in the
images as they are. The effect of the blur on noise and covariance: ``stereorig.core.matching.blur``.
"""

from __future__ import annotations

from stereorig.core.errors import InputError
from stereorig.core.settings import PREFILTER_OF_SUBSET


def check_prefilter(prefilter_px: float, subset_px: int) -> None:
    """Raise an error for a standard deviation that is negative, no number, or above a quarter of the subset.

    Raises
    ------
    InputError
        ``prefilter_invalid``.
    """
    if isinstance(prefilter_px, bool) or not 0.0 <= prefilter_px <= PREFILTER_OF_SUBSET * subset_px:
        raise InputError(
            f"the prefilter is {prefilter_px} px; it must lie in 0 (off) to a quarter of the subset, "
            f"{PREFILTER_OF_SUBSET * subset_px:g} px.",
            code="prefilter_invalid",
            remedy="Give 0.5 to 1, for example, or 0 for none; against noise a larger subset does more.",
        )
