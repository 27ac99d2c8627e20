"""Straight pieces of lines in a binary picture, sorted by direction.

The structure tensor gives each dark pixel's direction and, by its coherence, a measure of its certainty: at a crossing
there is no clear direction, so that lines are divided into the pieces between crossings. Their directions show the
families.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.grid.threshold import LinePicture

_COHERENCE = 0.5
FAMILY_REACH_RAD = float(np.radians(22.0))
_MAX_PIECES = 1500  # a family of 20 lines has 380
_MAX_PEAKS = 5
_PEAK_SHARE = 0.08  # share of the strongest direction; weaker ones are not half of a grid


@dataclass(frozen=True)
class Pieces:
    """Straight pieces in full-size pixels.

    Attributes
    ----------
    centre_px
        (n, 2).
    direction
        (n, 2) unit vectors.
    length_px, weight
        (n,) length, and sum of depths.
    """

    centre_px: Float
    direction: Float
    length_px: Float
    weight: Float

    def __len__(self) -> int:
        return len(self.length_px)

    def take(self, which: NDArray[np.intp]) -> Pieces:
        """Return the pieces at these indices."""
        return Pieces(self.centre_px[which], self.direction[which], self.length_px[which], self.weight[which])


@dataclass(frozen=True)
class Directions:
    """Direction of each dark pixel, and the picture's main directions.

    Attributes
    ----------
    angle_rad
        (rows, columns) direction along the line in [0, pi); y points down.
    usable
        (rows, columns) dark, with one clear direction.
    peaks_rad
        Main directions, the strongest first.
    """

    angle_rad: Float32
    usable: Bool
    peaks_rad: tuple[float, ...]


def directions(picture: LinePicture) -> Directions:
    """Find the directions of the lines of a picture."""
    gx = cv2.Scharr(picture.depth, cv2.CV_32F, 1, 0)
    gy = cv2.Scharr(picture.depth, cv2.CV_32F, 0, 1)
    sigma = 2.0
    xx, yy, xy = (cv2.GaussianBlur(g, (0, 0), sigma) for g in (gx * gx, gy * gy, gx * gy))
    diff, trace = xx - yy, xx + yy
    split = np.sqrt(diff**2 + 4.0 * xy**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherent = split > _COHERENCE * trace
    # the gradient's direction is across the line
    along = np.mod(0.5 * np.arctan2(2.0 * xy, diff) + 0.5 * np.pi, np.pi).astype(np.float32)
    usable = picture.mask & coherent
    counts, _ = np.histogram(along[usable], bins=180, range=(0.0, np.pi), weights=picture.depth[usable])
    smooth = gaussian_filter1d(counts.astype(np.float64), 4.0, mode="wrap")
    is_peak = (smooth == maximum_filter1d(smooth, 21, mode="wrap")) & (smooth > _PEAK_SHARE * smooth.max())
    order = sorted(np.flatnonzero(is_peak), key=lambda k: -smooth[k])[:_MAX_PEAKS]
    return Directions(along, usable, tuple(float(np.radians(k + 0.5)) for k in order))


def family_pieces(
    picture: LinePicture, found: Directions, direction_rad: float, reach_rad: float = FAMILY_REACH_RAD
) -> Pieces:
    """Collect the pieces that run within an angle of a direction."""
    off = np.abs(np.mod(found.angle_rad - direction_rad + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
    mask = found.usable & (off < reach_rad)
    n, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    y, x = np.nonzero(mask)
    label = labels[y, x]
    w = picture.depth[y, x].astype(np.float64)

    def total(values: Float) -> Float:
        return np.bincount(label, weights=values, minlength=n)[1:].astype(np.float64)

    size = np.bincount(label, minlength=n)[1:].astype(np.float64)
    sw = total(w)
    keep = (size >= 5) & (sw > 0.0)
    sw = np.where(keep, sw, 1.0)
    cx, cy = total(w * x) / sw, total(w * y) / sw
    xx = total(w * x * x) / sw - cx**2
    yy = total(w * y * y) / sw - cy**2
    xy = total(w * x * y) / sw - cx * cy
    split = np.sqrt(np.maximum((xx - yy) ** 2 + 4.0 * xy**2, 0.0))
    long_var, cross_var = 0.5 * (xx + yy + split), 0.5 * (xx + yy - split)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    # a piece is longer than it is wide, and runs the family's way
    off_piece = np.abs(np.mod(angle - direction_rad + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
    keep &= (long_var > 4.0 * cross_var) & (off_piece < reach_rad)
    which = np.flatnonzero(keep)
    if len(which) > _MAX_PIECES:
        which = which[np.argsort(-sw[which])[:_MAX_PIECES]]
    f = float(picture.factor)
    shift = 0.5 * (f - 1.0)  # a coarse pixel's centre, in full-size pixels
    direction = np.stack([np.cos(angle[which]), np.sin(angle[which])], axis=-1)
    flip = direction @ np.array([np.cos(direction_rad), np.sin(direction_rad)]) < 0.0
    direction[flip] *= -1.0
    return Pieces(
        np.stack([f * cx[which] + shift, f * cy[which] + shift], axis=-1),
        direction,
        f * np.sqrt(12.0 * long_var[which]),
        sw[which],
    )
