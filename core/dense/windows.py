"""The dense windows of a field: the narrow functions before the compiled kernels."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.dense.kernels import drivers
from stereorig.core.dense.kernels.finish import AtPoints, Limits, Shape
from stereorig.core.dense.kernels.given import DenseGiven, DenseOut, Lattice
from stereorig.core.field.points.prediction import Prediction
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.matching.arguments import flat, lens_of, own, reference_of, setting_of
from stereorig.core.matching.image import ImageData
from stereorig.core.matching.options import MatchOptions
from stereorig.core.status import PointStatus
from stereorig.core.threads import run_ranges, threads

_CUT_WIDTH_PX = 5  # two pixels on either side: there a spline includes the pixels beyond
_ROWS_AT_ONCE = 128
_MIN_ROWS = 32


@dataclass(frozen=True, eq=False)
class Windows:
    """A field's windows, solved.

    Attributes
    ----------
    xy_px
        (r, c, 2) the vectors, in camera 1's reference image.
    found
        Result at each.
    """

    xy_px: Float
    found: DenseOut


def node_positions(pair: StereoPair, xy_px: Float, state: Float, *, motion: bool) -> Float:
    """Return the image coordinates (r, c, 2 or 6) of an ordinary field's points, px, from their unknowns.

    Parameters
    ----------
    pair
        The cameras.
    xy_px
        (r, c, 2) points in camera 1's reference image.
    state
        (r, c, 5) inverse depth, current position over depth, epipolar offset.
    motion
        False: of camera 2's reference alone; True: also of camera 1's and camera 2's current image.
    """
    return _projected(pair, xy_px, state, 3 if motion else 1)[..., : 6 if motion else 2]


def _projected(pair: StereoPair, xy_px: Float, state: Float, images: int) -> Float:
    """(r, c, 9) of the points: image coordinates, then camera 2's shift across the epipolar line (``DenseGiven``)."""
    rows, cols = xy_px.shape[:2]
    out = np.full((rows * cols, 9), np.nan)
    pose = pair.cam2_from_cam1
    rays = own(pair.cam1.rays_cam(xy_px.reshape(-1, 2)).xyz_mm)
    given = own(np.nan_to_num(state.reshape(-1, 5), nan=1.0))
    drivers.project(
        lens_of(pair.cam1), lens_of(pair.cam2), own(pose.rotation), own(pose.translation_mm), rays, given, images, out
    )
    out[~np.isfinite(state).all(axis=2).ravel()] = np.nan
    return out.reshape(rows, cols, 9)


def measure_windows(
    pair: StereoPair,
    images: list[ImageData],
    xy_px: Float,
    state: Float,
    prediction: Prediction,
    options: MatchOptions,
    *,
    step_px: int,
    cuts: Cuts | None,
    white: Bool | None,
) -> Windows:
    """Measure the vectors between the points of an ordinary field.

    Parameters
    ----------
    pair
        The cameras.
    images
        Camera 1's and camera 2's reference image and, for a motion, both current ones.
    xy_px
        (r, c, 2) the field's points.
    state
        (r, c, 5) their unknowns.
    prediction
        Made of them.
    options
        Options of the field's matching.
    step_px
        Distance of vectors.
    cuts, white
        Lines and the mask's white, which no window crosses or leaves.
    """
    motion = len(images) == 4
    reference, n = images[0], len(images) - 1
    rows_px, cols_px = reference.shape
    node_rows, node_cols = xy_px.shape[:2]
    spacing = float(xy_px[0, 1, 0] - xy_px[0, 0, 0]) if node_cols > 1 else float(xy_px[1, 0, 1] - xy_px[0, 0, 1])
    x0, y0 = float(xy_px[0, 0, 0]), float(xy_px[0, 0, 1])
    rows, cols = (int((count - 1) * spacing / step_px + 1e-9) + 1 for count in (node_rows, node_cols))
    half = options.subset_px // 2
    first, last = _inside(x0, step_px, cols, half, cols_px)
    first_row, last_row = _inside(y0, step_px, rows, half, rows_px)
    levels = np.array([float(np.mean(image.raw[::4, ::4])) for image in images])
    setting = setting_of(options, images)
    to_sys = pair.cam1.sys_from_cam
    pose = pair.cam2_from_cam1
    given = DenseGiven(
        reference=reference_of(reference),
        blocked=_blocked(reference.shape, cuts, white),
        images=tuple(flat(image) for image in images[1:]),
        lens1=lens_of(pair.cam1),
        lens2=lens_of(pair.cam2),
        R=own(pose.rotation),
        t=own(pose.translation_mm),
        to_sys=own(np.concatenate([to_sys.rotation, to_sys.translation_mm[:, None]], axis=1)),
        lattice=Lattice(x0, y0, spacing, int(step_px), first, last, prediction.rim),
        nodes=own(prediction.nodes),
        seen=prediction.seen.astype(np.uint8),
        cells=prediction.cells.astype(np.uint8),
        state=own(np.concatenate([state, _projected(pair, xy_px, state, n)[..., 6:]], axis=-1)),
        levels=levels,
        subset=options.subset_px,
        order=setting.order,
        variances=setting.variances,
    )

    def empty(*tail: int, dtype: type = np.float32) -> NDArray[Any]:
        return np.full((rows, cols, *tail), np.nan, dtype)

    out = DenseOut(
        values=empty(6 if motion else 3, dtype=np.float64),
        covariance=empty(21 if motion else 6),
        epipolar=empty(dtype=np.float64),
        zncc=empty(n, dtype=np.float64),
        misfit=empty(n),
        moved=empty(n),
        sigma=empty(),
        status=np.full((rows, cols), PointStatus.OUTSIDE_IMAGE, np.int8),
    )
    run, make = (drivers.motion_rows, drivers.motion_space) if motion else (drivers.shape_rows, drivers.shape_space)
    local = threading.local()
    cells = prediction.seen.shape[1]

    def work(begin: int, end: int) -> None:
        if not hasattr(local, "space"):
            local.space = make(cols_px, options.subset_px, cells, max(last - first, 1))
        run(begin + first_row, end + first_row, given, local.space, out)

    if last > first and last_row > first_row and prediction.cells.any():
        count = last_row - first_row
        size = min(_ROWS_AT_ONCE * max(1, options.subset_px // (16 * step_px)), -(-count // threads()))
        run_ranges(work, count, max(size, _MIN_ROWS))
    x, y = np.meshgrid(x0 + step_px * np.arange(cols), y0 + step_px * np.arange(rows))
    return Windows(np.stack([x, y], axis=-1), out)


def _inside(start: float, step: int, count: int, half: int, size: int) -> tuple[int, int]:
    """First vector along an axis whose window is inside the image, and the one after the last."""
    middle = np.floor(start + 0.5) + step * np.arange(count)
    inside = np.flatnonzero((middle >= half) & (middle <= size - 1 - half))
    return (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, 0)


def _blocked(shape: tuple[int, int], cuts: Cuts | None, white: Bool | None) -> NDArray[np.uint8]:
    """Pixels of camera 1's reference image that do not count: next to a cut, and off the mask's white."""
    if not cuts and white is None:
        return np.zeros((0, 0), np.uint8)
    out = np.zeros(shape, np.uint8) if white is None else np.where(white, 0, 1).astype(np.uint8)
    for line in cuts.lines_px if cuts else ():
        cv2.polylines(out, [np.rint(line).astype(np.int32)], False, 1, _CUT_WIDTH_PX)
    return out


def finish_windows(windows: Windows, points: AtPoints, limits: Limits, shape: Shape) -> tuple[Float, Float]:
    """Check the vectors, in place, and return their covariance (r, c, n, n) mm^2 and noise (r, c) grey levels."""
    rows, cols, n = windows.found.values.shape
    covariance, noise = np.empty((rows, cols, n, n)), np.empty((rows, cols))

    def work(begin: int, end: int) -> None:
        drivers.finish_rows(begin, end, windows.found, points, limits, shape, covariance, noise)

    run_ranges(work, rows, _MIN_ROWS)
    return covariance, noise
