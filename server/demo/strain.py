"""Strain of the demo's fields along directions, measured and as the gauge would read it on the true surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import FileFormatError
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField, surface_strain
from stereorig.server.demo.session import DemoRun
from stereorig.server.formats.results.strain import read_strain
from stereorig.sim.truth import Truth

MICRO = 1e6
SAFE = 3.0  # standard deviations that chance is given


@dataclass(frozen=True)
class StrainDifference:
    """Measured strain against another, over some points; microstrain.

    Attributes
    ----------
    mean, rms
        Of measured minus the other.
    reported
        Root mean square of the standard deviations that the results report.
    chi
        Root mean square of the difference in units of its own sigma: 1 where noise explains all of it.
    """

    mean: float
    rms: float
    reported: float
    chi: float


def fetched_strain(session: DemoRun, steps: Sequence[int], folder: str = "results") -> list[StrainField]:
    """Read the strain of result files that ``session.fetch`` has kept.

    Raises
    ------
    FileFormatError
        If one holds none.
    """
    found = []
    for step in steps:
        strain = read_strain(session.out / folder / f"step_{step:04d}.nc")
        if strain is None:
            raise FileFormatError(f"The result of step {step} holds no strain.")
        found.append(strain)
    return found


def along(strain: StrainField, direction: ArrayLike) -> tuple[Float, Float]:
    """Strain along directions of the tangent plane and its standard deviation.

    Parameters
    ----------
    strain
        (r, c) points.
    direction
        (..., 2) over the strain's axes 1 and 2, which are X_sys and Y_sys on a surface that faces the cameras; any
        length, axis 1 for a length of zero.
    """
    n = np.asarray(direction, dtype=np.float64)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    n = np.where(length > 0.0, n, [1.0, 0.0]) / np.where(length > 0.0, length, 1.0)
    share = np.stack([n[..., 0] ** 2, n[..., 1] ** 2, 2.0 * n[..., 0] * n[..., 1]], axis=-1)
    variance = np.einsum("...i,...ij,...j", share, strain.total_covariance, share)
    return np.asarray((share * strain.strain).sum(axis=-1)), np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def as_read(result: Field, truth: Truth, strain: StrainField) -> StrainField:
    """Return the same gauge's reading on the true surface, at the same points and without noise."""
    true = replace(result, xyz_mm=truth.xyz_mm, uvw_mm=truth.uvw_mm)
    return surface_strain(true, strain.options, subset_px=strain.subset_px)


def difference(found: Float, other: Float, sigma: Float, use: Bool) -> StrainDifference:
    """Compare strain (r, c) with other values over the points ``use``."""
    off, sd = (found - other)[use], sigma[use]
    if not off.size:
        return StrainDifference(*[float("nan")] * 4)
    return StrainDifference(
        mean=MICRO * float(off.mean()),
        rms=MICRO * float(np.sqrt(np.mean(off**2))),
        reported=MICRO * float(np.sqrt(np.mean(sd**2))),
        chi=float(np.sqrt(np.mean((off / sd) ** 2))),
    )


def whole_gauges(strain: StrainField) -> Bool:
    """Return (r, c): points whose window no edge of the grid cuts."""
    half = strain.options.window // 2
    inner = np.zeros(strain.status.shape, bool)
    inner[half:-half, half:-half] = True
    return np.asarray(strain.valid & inner)


def chi_limit(strain: StrainField) -> float:
    """Return the largest chi that chance explains: as many independent readings as gauges fit into the field."""
    rows, cols = strain.status.shape
    gauges = rows * cols * (strain.spacing_px / strain.gauge_px) ** 2
    return 1.0 + SAFE / float(np.sqrt(2.0 * max(gauges, 1.0)))
