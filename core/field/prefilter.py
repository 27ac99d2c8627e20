"""A Gaussian prefilter of all images of a measurement: what may be asked for.

All images of all steps are blurred alike before gradients and splines are made of them; seeds are looked for in the
images as they are. What the blur does to noise and covariance stands in ``core.matching.blur``.
"""

from __future__ import annotations

from core.errors import InputError
from core.settings import PREFILTER_OF_SUBSET


def check_prefilter(prefilter_px: float, subset_px: int) -> None:
    """Refuse a standard deviation below zero, that is no number, or wider than a quarter of the subset.

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
