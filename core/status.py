"""Status of a measurement point."""

from __future__ import annotations

from enum import IntEnum


class PointStatus(IntEnum):
    """Status of a point; every status but ``OK`` and ``EXTRAPOLATED`` means that the point has no numbers."""

    OK = 0
    NOT_SEEDED = 1
    MASKED = 2
    OUTSIDE_IMAGE = 3
    LOW_TEXTURE = 4
    NOT_CONVERGED = 5
    LOW_CORRELATION = 6
    EPIPOLAR_MISMATCH = 7
    NEIGHBOUR_MISMATCH = 8
    SINGULAR = 9
    EXTRAPOLATED = 10
    SIGMA_TOO_LARGE = 11


STATUS_MEANINGS: dict[PointStatus, str] = {
    PointStatus.OK: "measured, and every check passed",
    PointStatus.NOT_SEEDED: "no start value reached this point",
    PointStatus.MASKED: "outside the region, in a hole or in the mask, or it sees too little of its subset",
    PointStatus.OUTSIDE_IMAGE: "the patch leaves one of the images or a lens model's domain",
    PointStatus.LOW_TEXTURE: "too little grey-level gradient for a match",
    PointStatus.NOT_CONVERGED: "the iteration did not settle",
    PointStatus.LOW_CORRELATION: "a correlation is below its limit",
    PointStatus.EPIPOLAR_MISMATCH: "camera 2 sees the point off the epipolar line",
    PointStatus.NEIGHBOUR_MISMATCH: "disagrees with its neighbours beyond the expected scatter",
    PointStatus.SINGULAR: "the normal equations cannot be solved",
    PointStatus.EXTRAPOLATED: "measured, but outside the calibrated volume: larger uncertainty",
    PointStatus.SIGMA_TOO_LARGE: "matched, but with a standard deviation above the limit, in depth too",
}
