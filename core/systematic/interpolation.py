"""The bias that interpolation of sharp texture gives matches, seen in their own residuals.

A spline through the pixels, and the pixels of a texture finer than they are, shift all matches alike by an amount that
goes with the sine of the sub-pixel phase. The effect comes from the highest frequencies: a match of smoothed images is
nearly free of it. At a sample of points the residuals show the change by such a match, and the part of it in proportion
to the phase's sine is the bias. If the map from image to image runs through phases within a subset they cancel there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float, Float32
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.matches import Matches, match_gain
from stereorig.core.field.points.result import Field
from stereorig.core.matching.blur import Blur
from stereorig.core.matching.filters import correlate
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.matching.image import ImageData
from stereorig.core.robust import MAD_TO_SIGMA
from stereorig.core.status import PointStatus
from stereorig.core.systematic.sampled import residual_shifts
from stereorig.core.systematic.term import Figure, Term

SMOOTH_PX = 1.5
"""Smoothing of the smoother gradients: little of the bias is left in them. With more smoothing the bias is less
certain. Wider ones see it less surely.
"""
_LARGE_PIXELS = 8_000_000  # from here on only the examined parts are smoothed: 8 bytes a pixel
_PROBED_PX = 21  # middle of a subset: a wider one costs more and adds little information
_SAMPLE = 256
_MIN_SAMPLE = 32
_SURE = 2.0
_MIN_SINE2 = 0.02  # mean square of the sines below which the phase shows nothing
_OUTLIER = 4.0
_QUANTITIES = ("x_um", "y_um", "z_um", "u_um", "v_um", "w_um")


@dataclass(frozen=True, eq=False)
class SmoothSlopes:
    """The reference image of camera 1 with its gradients, smoothed: made once for all steps, but of a large image.

    Attributes
    ----------
    image
        As it was matched.
    whole
        (rows, cols) its gradients along x and y after a Gaussian of :data:`SMOOTH_PX`; None for a large image: the
        examined parts are then smoothed each time.
    """

    image: ImageData
    whole: tuple[Float32, Float32] | None

    @staticmethod
    def of(image: ImageData) -> SmoothSlopes:
        """Return the smoothed gradients of a prepared image."""
        if image.raw.size > _LARGE_PIXELS:
            return SmoothSlopes(image, None)
        along_x, along_y = (np.empty(image.shape, np.float32) for _ in range(2))
        taps = Blur(SMOOTH_PX).taps
        for slope, smooth in zip(image.gradients, (along_x, along_y), strict=True):
            correlate(slope, taps, taps, smooth)
        return SmoothSlopes(image, (along_x, along_y))

    def about(self, centres_px: Float, half: int) -> tuple[Float32, Float32]:
        """Return both (n, 2 half + 1, 2 half + 1) about points (n, 2); undefined where these leave the image."""
        side, (rows, cols) = 2 * half + 1, self.image.shape
        out = np.zeros((2, len(centres_px), side, side), np.float32)
        taps = Blur(SMOOTH_PX).taps.astype(np.float32)
        reach = len(taps) // 2
        for k, (x, y) in enumerate(np.rint(centres_px).astype(int).tolist()):
            if x < half or y < half or x + half >= cols or y + half >= rows:
                continue
            left, top = x - half, y - half
            for axis in range(2):
                if self.whole is not None:
                    out[axis, k] = self.whole[axis][top : top + side, left : left + side]
                    continue
                first_x, first_y = max(left - reach, 0), max(top - reach, 0)
                wide = self.image.gradients[axis][first_y : top + side + reach, first_x : left + side + reach]
                smooth = cv2.sepFilter2D(wide, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
                out[axis, k] = smooth[top - first_y :, left - first_x :][:side, :side]
        return out[0], out[1]


def interpolation_term(
    field: Field, pair: StereoPair, reference: SmoothSlopes, others: Sequence[ImageData], *, subset_px: int
) -> Term:
    """Estimate the bias of interpolation in a field.

    Parameters
    ----------
    field
        As it was measured.
    pair
        The cameras.
    reference
        Camera 1's reference image.
    others
        Camera 2's reference image and, of a displacement, camera 1's and camera 2's current ones.
    subset_px
        Width of the subset.

    Returns
    -------
    Term
        ``match_px`` over points, comparisons and directions, and each coordinate in um.
    """
    if field.references is not None:
        return Term("Not known: the step was matched against a later reference.")
    index = np.flatnonzero((field.status == PointStatus.OK).ravel() & np.isfinite(field.normal_sys[..., 0].ravel()))
    if len(index) < _MIN_SAMPLE:
        return Term(f"Not known: {len(index)} points are too few.")
    index = index[np.linspace(0, len(index) - 1, min(_SAMPLE, len(index))).astype(np.int64)]
    centres = np.stack([field.x_px.ravel()[index], field.y_px.ravel()[index]], axis=-1)
    found = _matches(field, pair, index)
    images = found.images_px.copy()
    offset = field.epipolar_px.ravel()[index]
    images += np.where(np.isfinite(offset), offset, 0.0)[:, None, None] * found.across
    probed_px = min(subset_px, _PROBED_PX)
    slopes, smooth = reference.image.gradients, reference.about(centres, probed_px // 2)
    shifts, sines, left = [], [], []
    for k, other in enumerate(others):
        seen = residual_shifts(
            reference.image.pixels,
            slopes,
            smooth,
            other.coefficients,
            other.order,
            centres,
            images[:, k],
            found.maps[:, k],
            probed_px,
        )
        # in px of the other image, along its rows and columns
        shifts.append((found.maps[:, k] @ (seen[:, :2] - seen[:, 2:])[..., None])[..., 0])
        sine = np.sin(2.0 * np.pi * images[:, k])
        sines.append(sine * _left_of_phase(found.maps[:, k], probed_px))
        left.append(sine * _left_of_phase(found.maps[:, k], subset_px))
    together = np.stack(shifts, axis=1), np.stack(sines, axis=1), np.stack(left, axis=1)
    return _judged(*together, found, field.has_motion)


def _judged(shifts: Float, sines: Float, left: Float, found: Matches, moved: bool) -> Term:
    """Term from shifts (n, comparisons, 2), from the sines in the probed parts, and in the whole subsets."""
    amplitude, sd = np.full(2, np.nan), np.full(2, np.nan)
    for axis in range(2):
        found_here = _amplitude(sines[..., axis].ravel(), shifts[..., axis].ravel())
        if found_here is not None:
            amplitude[axis], sd[axis] = found_here
    known = np.isfinite(amplitude)
    if not known.any():
        return Term(
            "Not known: within the subsets the phase runs through whole pixels, so that the bias cancels, or all "
            "points are at whole or half pixels, without any bias."
        )
    # a direction without information has little of it: the texture is assumed to be as sharp as along the other
    amplitude, sd = (np.where(known, values, values[known].max()) for values in (amplitude, sd))
    shown = bool((np.abs(amplitude) > _SURE * sd).any())
    text = (
        f"From {len(shifts)} points' residuals: what a match through gradients smoothed by {SMOOTH_PX:g} px would "
        f"change with the sub-pixel phase's sine, amplitude {1e3 * amplitude[0]:.2g} and {1e3 * amplitude[1]:.2g} "
        f"thousandths of a pixel along rows and columns (standard deviation {1e3 * sd[0]:.1g}, {1e3 * sd[1]:.1g}); at "
        "this field's phases."
    )
    bias = left * np.where(np.abs(amplitude) > _SURE * sd, amplitude, 0.0)
    bound = left * (np.abs(amplitude) + _SURE * sd)
    figures = {"match_px": _figure(bias, bound, shown)}
    for k, (value, limit) in enumerate(zip(_to_mm(bias, found), _to_mm(bound, found), strict=True)):
        if k >= 3 or not moved:
            figures[_QUANTITIES[k]] = _figure(1e3 * value, 1e3 * limit, shown)
    return Term(text, figures)


def _amplitude(sines: Float, shifts: Float) -> tuple[float, float] | None:
    """Amplitude of the shifts in proportion to the sines (n,), and its standard deviation; None without information."""
    known = np.isfinite(sines) & np.isfinite(shifts)
    s, d = sines[known], shifts[known]
    if len(s) < _MIN_SAMPLE or not np.mean(s**2) > _MIN_SINE2:
        return None
    off = np.abs(d - np.median(d))
    kept = off <= _OUTLIER * MAD_TO_SIGMA * np.median(off)
    s, d = s[kept], d[kept]
    square = float(s @ s)
    found = float(s @ d) / square
    return found, float(np.sqrt(np.mean((d - found * s) ** 2) / square))


def _figure(bias: Float, bound: Float, shown: bool) -> Figure:
    below = float(np.sqrt(np.nanmean(bound**2)))
    if not shown:
        return Figure(None, None, below)
    return Figure(float(np.sqrt(np.nanmean(bias**2))), float(np.nanmax(np.abs(bias))), below)


def _to_mm(shifts_px: Float, found: Matches) -> Float:
    """(3 or 6, n) of X, Y, Z, U, V, W, mm, of shifts (n, comparisons, 2) in px of the other images."""
    in_reference = np.linalg.solve(found.maps, shifts_px[..., None])[..., 0]
    return np.asarray(np.einsum("nij,nj->in", found.gain, in_reference.reshape(len(shifts_px), -1)))


def _left_of_phase(maps: Float, subset_px: int) -> Float:
    """(n, 2) mean over a subset of a sine of the phase along the other image's axes."""
    # whole pixels of the reference: a map's whole numbers change no phase
    off = np.pi * (maps - np.rint(maps))
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(np.abs(off) < 1e-9, 1.0, np.sin(subset_px * off) / (subset_px * np.sin(off)))
    return np.asarray(each[..., 0] * each[..., 1])


def _matches(field: Field, pair: StereoPair, index: np.ndarray) -> Matches:
    points, normals = field.xyz_mm.reshape(-1, 3)[index], field.normal_sys.reshape(-1, 3)[index]
    if field.uvw_mm is None:
        return match_gain(pair, points, normals)
    displaced = points + field.uvw_mm.reshape(-1, 3)[index]
    moved = None
    if field.rotation_rad is not None and field.stretch is not None:
        e = field.stretch.reshape(-1, 3)[index]
        stretched = np.eye(2) + np.stack([e[:, 0], e[:, 2], e[:, 2], e[:, 1]], axis=-1).reshape(-1, 2, 2)
        turned = Rotation.from_rotvec(field.rotation_rad.reshape(-1, 3)[index]).as_matrix()
        moved = turned @ tangent_frames(normals)[..., :2] @ stretched
    return match_gain(pair, points, normals, displaced, moved)
