"""The noise of a match from a pattern that is assumed: the Cramer-Rao bound with the matcher's own gradients.

The pattern's autocorrelation is taken for a Gaussian of standard deviation s = speckle / 2.355, so that its mean
squared gradient along one direction is (contrast / s)^2. The matcher takes gradients by a Wiener filter, i k S / (S +
N) for a spectrum S under white noise N; the sum of their squares is the sensitivity to a shift.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.plan.settings import PlannedMeasurement

_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
_STEPS = 2000


def match_variance_px2(plan: PlannedMeasurement) -> float:
    """Return the variance of a subset's shift by one image's noise, per direction, px^2.

    A comparison of two images has twice it.
    """
    contrast2, noise2 = plan.contrast_grey**2, plan.image_noise_grey**2
    return float(noise2 / (plan.subset_px**2 * _sensitivity(contrast2, correlation_px(plan), noise2)))


def correlation_px(plan: PlannedMeasurement) -> float:
    """Return the standard deviation of the Gaussian that the pattern's autocorrelation is taken for, px."""
    if plan.gradient_grey_per_px is not None:
        return plan.contrast_grey / plan.gradient_grey_per_px
    return float(plan.speckle_px / _FWHM)


def _sensitivity(contrast2: float, s_px: float, noise2: float) -> float:
    """Mean square of the filtered gradient along one direction: the integral of kx^2 S^2 / (S + N) over Nyquist's."""
    # polar, out to where the square of Nyquist frequencies ends; S falls off long before for any pattern that is seen
    k = (np.arange(_STEPS) + 0.5) * np.pi / _STEPS
    spectrum = contrast2 * 2.0 * np.pi * s_px**2 * np.exp(-0.5 * (k * s_px) ** 2)
    passed = spectrum**2 / (spectrum + noise2)
    return float((0.5 * k**2 * passed * k).sum() * (np.pi / _STEPS) / (2.0 * np.pi))
