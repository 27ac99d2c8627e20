"""The drawn crack and the frame of its tip: x ahead along the crack, y to its left, z the surface's normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.line_crossings import find_near
from stereorig.core.gauge.align import align_plane
from stereorig.server.evaluations.crack.settings import CrackSettings

_STRAIGHT = 0.05  # share of the ring's outer radius by which the line may leave a straight one
_DRAWN_PX = 2.0  # as well as a line is drawn
_FEWEST = 12  # points by which the surface is known


@dataclass(frozen=True, eq=False)
class DrawnCrack:
    """A crack as it was drawn, in camera 1's reference image, and the frame of its tip.

    Attributes
    ----------
    line_px
        (m, 2) the tip last.
    axes, origin_mm
        (3, 3) the frame's axes as rows, and (3,) the tip on the reference's surface, both in the system frame.
    mm_per_px
        (2, 2) change of x and y with the image's column and row.
    length_mm, inner_mm, outer_mm
        Length of the line, and distances from the tip between which points are used.
    """

    line_px: Float
    axes: Float
    origin_mm: Float
    mm_per_px: Float
    length_mm: float
    inner_mm: float
    outer_mm: float

    @property
    def scale(self) -> float:
        """Millimetres of a pixel."""
        return float(np.sqrt(abs(np.linalg.det(self.mm_per_px))))

    def pixel(self, xy_mm: Float) -> Float:
        """Return the image position (2,) of a position in the frame."""
        return np.asarray(self.line_px[-1] + np.linalg.solve(self.mm_per_px, xy_mm))


def drawn_crack(field: Field, shared: SharedPixels, asked: CrackSettings) -> DrawnCrack:
    """Return the crack that is stated or drawn, and the frame of its tip on the reference's surface.

    Raises
    ------
    InputError
        ``crack_not_drawn``; ``crack_unclear`` if several are; ``crack_outside`` if the tip is not in the field;
        ``crack_ring_invalid``; ``crack_kinked`` if the line is not straight within the ring; ``crack_not_alone`` if
        another line is in it.
    MeasurementError
        ``too_few_points`` for the surface's plane.
    """
    line, others = _lines(field.cuts, asked)
    x, y, tip = field.x_px[0], field.y_px[:, 0], line[-1]
    border = float(min(tip[0] - x[0], x[-1] - tip[0], tip[1] - y[0], y[-1] - tip[1]))
    if border <= 0.0:
        raise InputError(
            f"The tip at ({tip[0]:g}, {tip[1]:g}) px is not within the field.",
            code="crack_outside",
            remedy="Name the crack's other end by tip, or measure a region with the tip inside.",
        )
    surface = _surface(field)
    slope = 0.5 * (surface(tip + np.eye(2)) - surface(tip - np.eye(2)))
    scale = float(np.sqrt(np.linalg.norm(np.cross(slope[0], slope[1]))))
    reach_px = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[::-1], axis=0), axis=1))])
    inner_mm, outer_mm = asked.ring_mm(shared.subset_px * scale, scale * min(0.5 * float(reach_px[-1]), border))
    outer_px = outer_mm / scale
    back = np.array([np.interp(outer_px, reach_px, line[::-1, k]) for k in (0, 1)])
    away, chord = line[::-1][reach_px < outer_px] - tip, (back - tip) / np.linalg.norm(back - tip)
    off = float(np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]).max())
    if off > max(_DRAWN_PX, _STRAIGHT * outer_px):
        raise InputError(
            f"Within {outer_mm:.4g} mm of its tip the crack leaves a straight line by {off:.3g} px: it is kinked.",
            code="crack_kinked",
            remedy="State an outer_mm within which it is straight; about a kink the series does not hold.",
        )
    near = np.zeros(1, bool)
    find_near(0, 1, tip[None], 0, outer_px, Cuts(others).pieces_px, np.zeros((1, 1), np.int64), near)
    if near[0]:
        raise InputError(
            f"Another crack or a hole lies within {outer_mm:.4g} mm of the tip.",
            code="crack_not_alone",
            remedy="State a smaller outer_mm.",
        )
    about = np.hypot(field.x_px - tip[0], field.y_px - tip[1]) <= outer_px
    axes = align_plane(field, shared=shared, chosen=about, x_direction=surface(tip) - surface(back)).rotation
    length = float(np.linalg.norm(np.diff(surface(line), axis=0), axis=1).sum())
    return DrawnCrack(line, axes, surface(tip), (slope @ axes[:2].T).T, length, inner_mm, outer_mm)


def _lines(cuts: Cuts | None, asked: CrackSettings) -> tuple[Float, list[Float]]:
    """Return the crack, its tip last, and the other lines."""
    lines = [] if cuts is None else list(cuts.lines_px)
    cracks = [line for line in lines if not np.array_equal(line[0], line[-1])]
    if asked.crack_px is not None:
        # a stated line may be a drawn one as well
        chosen, others = Cuts([asked.crack_px]).lines_px[0], [x for x in lines if not any(x is one for one in cracks)]
    elif len(cracks) == 1:
        chosen, others = cracks[0], [line for line in lines if line is not cracks[0]]
    else:
        raise InputError(
            f"{len(cracks)} cracks are drawn in the region that was measured.",
            code="crack_unclear" if cracks else "crack_not_drawn",
            remedy="State crack_px, or draw the crack as a line and measure again.",
        )
    return (chosen if asked.tip == "last" else chosen[::-1]), others


def _surface(field: Field) -> Callable[[Float], Float]:
    """Return a function of pixels (..., 2): positions (..., 3) on quadratics through the reference's surface."""
    used = field.valid
    at = np.stack([field.x_px[used], field.y_px[used]], axis=-1)
    if len(at) < _FEWEST:
        raise MeasurementError(
            f"{len(at)} points of the reference are measured.",
            code="too_few_points",
            remedy="Look at the points' status.",
        )
    middle, reach = at.mean(axis=0), max(float(np.ptp(at, axis=0).max()), 1.0)

    def powers(at_px: Float) -> Float:
        a, b = np.moveaxis((at_px - middle) / reach, -1, 0)
        return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=-1)

    terms = np.linalg.lstsq(powers(at), field.xyz_mm[used], rcond=None)[0]
    return lambda at_px: np.asarray(powers(at_px) @ terms)
