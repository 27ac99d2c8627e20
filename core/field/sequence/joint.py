"""The joint between two blocks of a sequence that were measured side by side.

A block's first step is measured twice: from seeds, so that the steps after it need not wait, and again from the step
before it once that is there, as a sequence measured in order does. If both agree, all results measured from the first
are the results that the second leads to.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.field.points.result import Field

AGREE_SIGMAS = 0.02
"""Root mean square of the differences of displacements over their standard deviations; a next step keeps less of it."""


def agree(one: Field, two: Field) -> bool:
    """Return True if two measurements of a step lead to the same next step.

    Parameters
    ----------
    one, two
        Fields (r, c) with a motion: the same valid points, references and patch, and displacements that differ by at
        most ``AGREE_SIGMAS`` of their standard deviations, rms.

    Returns
    -------
    bool
        False also for fields without a valid point.
    """
    if one.uvw_mm is None or two.uvw_mm is None or not np.array_equal(one.valid, two.valid) or not one.valid.any():
        return False
    patches = [None if field.patch is None else field.patch.patch for field in (one, two)]
    if patches[0] != patches[1] or not _same_references(one, two):
        return False
    valid = one.valid
    own = np.sqrt(np.diagonal(one.covariance, axis1=-2, axis2=-1))[valid][:, 3:]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = (one.uvw_mm - two.uvw_mm)[valid] / own
    return bool(np.sqrt(np.mean(off**2)) <= AGREE_SIGMAS)


def _same_references(one: Field, two: Field) -> bool:
    a, b = one.references, two.references
    if a is None or b is None:
        return a is b
    return a.step == b.step and bool(np.array_equal(a.steps[one.valid], b.steps[two.valid]))
