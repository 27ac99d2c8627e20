"""Virtual extensometers: the distance of two points of the surface, and its change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.reading import MISSING, Reading, reading_of
from stereorig.core.gauge.sampling import Samples, sample


@dataclass(frozen=True)
class Extensometer:
    """Readings of a virtual extensometer in one step.

    Attributes
    ----------
    length0_mm
        Distance L0 of its ends at the reference.
    length_mm
        Current distance L; L0 for a shape.
    elongation_mm
        L - L0.
    strain
        Engineering strain L / L0 - 1.
    true_strain
        ln(L / L0).
    missing
        Reason for missing numbers; empty if there are numbers.
    """

    length0_mm: Reading = MISSING
    length_mm: Reading = MISSING
    elongation_mm: Reading = MISSING
    strain: Reading = MISSING
    true_strain: Reading = MISSING
    missing: str = ""


def extensometer(field: Field, a_px: ArrayLike, b_px: ArrayLike, *, shared: SharedPixels) -> Extensometer:
    """Read a virtual extensometer between two positions of camera 1's reference image.

    It may span a cut or a hole: only its ends need valid points about them.

    Parameters
    ----------
    field
        A shape, which has a length only, or a displacement field.
    a_px, b_px
        Its ends (x, y).
    shared
        The correlation of neighbouring points.

    Raises
    ------
    RegionError
        ``gauge_outside``; ``gauge_unusable`` if both ends coincide.
    """
    ends = np.array([a_px, b_px], dtype=np.float64)
    if np.array_equal(ends[0], ends[1]):
        raise RegionError(
            f"Both ends of the extensometer lie at ({ends[0, 0]:g}, {ends[0, 1]:g}) px.",
            code="gauge_unusable",
            remedy="Give two different positions.",
        )
    samples = sample(field, ends)
    why = [f"end {k}: {text}" for k, text in zip("ab", samples.missing, strict=True) if text]
    if why:
        return Extensometer(missing=", ".join(why))
    cov = _both_ends(samples, shared)
    at_reference = samples.reference_alone()
    frozen = None if at_reference is None else _both_ends(at_reference, shared)
    common = samples.common()
    ends_common = None if common is None else common.reshape(cov.shape[0], -1)
    n = cov.shape[0] // 2
    start = samples.of(field.xyz_mm)
    now = start if field.uvw_mm is None else start + samples.of(field.uvw_mm)
    along0, along = start[1] - start[0], now[1] - now[0]
    length0, length = float(np.linalg.norm(along0)), float(np.linalg.norm(along))
    rest = np.zeros(n - 3)
    d0 = np.concatenate([-along0, rest, along0, rest]) / length0
    moving = -along if n == 3 else np.concatenate([-along, -along])
    d = np.concatenate([moving, -moving]) / length

    def reading(value: float, slope: Float) -> Reading:
        of_reference = None if frozen is None else float(slope @ frozen @ slope)
        row = None if ends_common is None else slope @ ends_common
        return reading_of(value, float(slope @ cov @ slope), of_reference, row, field.causes)

    if field.uvw_mm is None:
        return Extensometer(length0_mm=reading(length0, d0), length_mm=reading(length0, d0))
    return Extensometer(
        length0_mm=reading(length0, d0),
        length_mm=reading(length, d),
        elongation_mm=reading(length - length0, d - d0),
        strain=reading(length / length0 - 1.0, d / length0 - length / length0**2 * d0),
        true_strain=reading(float(np.log(length / length0)), d / length - d0 / length0),
    )


def _both_ends(samples: Samples, shared: SharedPixels) -> Float:
    """(2 n, 2 n) covariance of both ends' positions and displacements."""
    aa, ab, bb = samples.covariance(shared, [0, 0, 1], [0, 1, 1])
    return np.block([[aa, ab], [ab.T, bb]])
