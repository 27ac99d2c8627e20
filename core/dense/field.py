"""A dense field: a vector every few pixels, from an ordinary field and the images that it was measured on.

The ordinary field, with all its checks, is the prediction. Each vector is one Gauss-Newton step from it over the whole
window about the vector, with offset and gain taken out, in the three comparisons of the ordinary fit; their joint
covariance weighs them, and the exact cameras turn them into a position and a displacement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.dense.prediction import predict
from core.dense.windows import Windows, measure_windows, node_positions
from core.errors import InputError
from core.field.points.dense_record import DenseRecord
from core.field.points.images import MeasureImage
from core.field.points.result import Field
from core.field.region.region import PointGrid
from core.field.settings import MeasureOptions
from core.settings import DENSE_STEP_PX
from core.status import PointStatus

_SD = 6.0  # robust standard deviations
_MISFIT = (2.0, 6.0)  # least and largest limit on a residual over that of the points about
_STEP_PX = 0.05  # an increment beyond it and six times the field's median is no small step from the prediction
_OFFSET_PX = 0.01
_AT_ONCE = 64  # rows of vectors that are turned into a field together


def dense_shape(
    pair: StereoPair,
    images: Sequence[MeasureImage],
    shape: Field,
    grid: PointGrid,
    options: MeasureOptions,
    *,
    step_px: int = DENSE_STEP_PX.default,
) -> Field:
    """Measure a dense shape.

    Parameters
    ----------
    pair
        The cameras.
    images
        Camera 1's and camera 2's reference image.
    shape
        The ordinary shape, as it was measured.
    grid, options
        With which it was measured.
    step_px
        Distance of vectors; at most that of the ordinary points.

    Returns
    -------
    Field
        Of ``(n - 1) spacing / step + 1`` vectors along each axis, the first on the first ordinary point. Vectors lie
        between four valid points of one smooth part whose windows meet no cut; elsewhere ``status`` is ``MASKED``.
        Normals, angles, rotation and stretch are not measured: NaN.

    Raises
    ------
    InputError
        ``dense_step_invalid``.
    """
    return _measure(pair, images, shape, None, None, grid, options, step_px)


def dense_motion(
    pair: StereoPair,
    images: Sequence[MeasureImage],
    shape: Field,
    motion: Field,
    dense: Field,
    grid: PointGrid,
    options: MeasureOptions,
    *,
    step_px: int = DENSE_STEP_PX.default,
) -> Field:
    """Measure a dense displacement.

    Parameters
    ----------
    pair
        The cameras.
    images
        Camera 1's and camera 2's reference image, camera 1's and camera 2's current image.
    shape, motion
        The ordinary shape and displacement, as they were measured: not smoothed.
    dense
        The dense shape on the same step, whose positions each step shows.
    grid, options, step_px
        As in :func:`dense_shape`.

    Raises
    ------
    InputError
        As :func:`dense_shape`; ``dense_needs_first_reference`` where the step was matched against a later reference;
        ``grid_mismatch`` for a dense shape of other points.
    """
    if motion.references is not None:
        raise InputError(
            "the step was matched against a later reference.",
            code="dense_needs_first_reference",
            remedy="Measure with reference_update = never, or take the ordinary field of this step.",
        )
    return _measure(pair, images, shape, motion, dense, grid, options, step_px)


def _measure(
    pair: StereoPair,
    images: Sequence[MeasureImage],
    shape: Field,
    motion: Field | None,
    dense: Field | None,
    grid: PointGrid,
    options: MeasureOptions,
    step_px: int,
) -> Field:
    ordinary = shape if motion is None else motion
    _check(grid, step_px)
    prepared = [image.prepared(options.interpolation, noise, options.blur) for image, noise in
                zip(images, (*options.noise, *options.noise), strict=False)]  # fmt: skip
    state = _state(pair, ordinary)
    measured = ordinary.valid & shape.valid
    prediction = predict(
        grid.xy_px,
        node_positions(pair, grid.xy_px, state, motion=motion is not None),
        measured,
        grid.cuts,
        subset_px=options.subset_px,
    )
    windows = measure_windows(
        pair,
        prepared,
        grid.xy_px,
        state,
        prediction,
        options.match_options(),
        step_px=step_px,
        cuts=grid.cuts,
        white=grid.white,
    )
    if dense is not None and dense.shape != windows.status.shape:
        raise InputError(
            f"the dense shape has {dense.shape} vectors, the displacement {windows.status.shape}.",
            code="grid_mismatch",
            remedy="Measure every step with one dense step.",
        )
    return _field(windows, ordinary, dense, grid, options, step_px)


def _check(grid: PointGrid, step_px: int) -> None:
    if not (DENSE_STEP_PX.holds(step_px) and step_px <= grid.spacing_px):
        raise InputError(
            f"the dense step is {step_px} px, it must be {DENSE_STEP_PX} and at most the points' spacing, "
            f"{grid.spacing_px:g} px.",
            code="dense_step_invalid",
            remedy=f"Give {DENSE_STEP_PX.default}, for example.",
        )


def _state(pair: StereoPair, field: Field) -> Float:
    """Inverse depth, current position over depth, epipolar offset: (r, c, 5)."""
    at_reference = pair.cam1.cam_from_sys.apply(field.xyz_mm)
    w = 1.0 / at_reference[..., 2:]
    now = at_reference if field.uvw_mm is None else pair.cam1.cam_from_sys.apply(field.xyz_mm + field.uvw_mm)
    return np.concatenate([w, now * w, field.epipolar_px[..., None]], axis=-1)


class _Between:
    """Values of an ordinary field's points at the vectors between them, linear along both axes."""

    def __init__(self, nodes: tuple[int, int], vectors: tuple[int, int], spacing: float, step: int) -> None:
        self.rows, self.cols = (self._axis(n, m, spacing, step) for n, m in zip(nodes, vectors, strict=True))
        # vectors nearest to the points
        self.at_nodes = np.ix_(*(
            np.minimum(np.rint(np.arange(n) * spacing / step).astype(int), m - 1)
            for n, m in zip(nodes, vectors, strict=True)
        ))  # fmt: skip

    @staticmethod
    def _axis(nodes: int, vectors: int, spacing: float, step: int) -> tuple[NDArray[np.int64], Float]:
        along = np.arange(vectors) * step / spacing
        first = np.minimum(along.astype(np.int64), max(nodes - 2, 0))
        return first, along - first

    def of(self, values: Float, rows: slice) -> Float:
        """Values (r, c, ...) of points at some rows of vectors; a point without a value takes the field's median."""
        axes = (0, 1)
        known = np.isfinite(values)
        if not known.all():
            values = np.where(known, values, np.nanmedian(values, axis=axes) if known.any() else np.nan)
        (r, v), (c, u) = self.rows, self.cols
        tail = (None,) * (values.ndim - 2)
        v, u = v[rows][(slice(None), *tail)], u[(slice(None), *tail)]
        low, high = values[r[rows]], values[np.minimum(r[rows] + 1, len(values) - 1)]
        along = low + v[:, None] * (high - low)
        right = np.minimum(c + 1, values.shape[1] - 1)
        return np.asarray(along[:, c] + u * (along[:, right] - along[:, c]))


def _field(
    windows: Windows, ordinary: Field, dense: Field | None, grid: PointGrid, options: MeasureOptions, step_px: int
) -> Field:
    """Check the vectors and give them their covariance."""
    rows, cols = windows.status.shape
    n = windows.values.shape[2]
    between = _Between(grid.shape, (rows, cols), grid.spacing_px, step_px)
    at_nodes = between.at_nodes
    # the ordinary field's variance over that of the normal equations, of positions and of displacements
    upper = {3: (0, 3, 5), 6: (0, 6, 11, 15, 18, 20)}[n]
    own = windows.covariance[at_nodes][..., upper]
    theirs = np.diagonal(ordinary.covariance, axis1=2, axis2=3)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.stack(
            [theirs[..., a : a + 3].sum(axis=-1) / own[..., a : a + 3].sum(axis=-1) for a in range(0, n, 3)], axis=-1
        )
    misfit = windows.misfit[at_nodes]
    limits = _Limits(windows, misfit, between, ordinary)
    i, j = np.triu_indices(n)
    status = windows.status.copy()
    covariance = np.full((rows, cols, n, n), np.nan)
    values, noise = windows.values, np.full((rows, cols), np.nan)
    for first in range(0, rows, _AT_ONCE):
        part = slice(first, min(first + _AT_ONCE, rows))
        scale = between.of(ratio, part)
        ok = status[part] == PointStatus.OK
        failed = limits.failed(part, np.sqrt(scale.max(axis=-1)), options)
        status[part] = np.where(ok, failed, status[part])
        if dense is not None:  # only the shape's valid points are measured
            status[part] = np.where(dense.valid[part], status[part], dense.status[part])
        bad = status[part] != PointStatus.OK
        values[part][bad] = np.nan
        root = np.sqrt(scale)[..., [k // 3 for k in range(n)]]
        entries = windows.covariance[part] * root[..., i] * root[..., j]
        entries[bad] = np.nan
        block = covariance[part]
        block[..., i, j] = block[..., j, i] = entries
        noise[part] = np.where(bad, np.nan, between.of(ordinary.noise_grey, part))
    valid = status == PointStatus.OK
    xyz = values[..., :3]
    if dense is not None:
        xyz = np.where(valid[..., None], dense.xyz_mm, np.nan)
        _keep_shape(covariance, dense, valid)
    empty = np.full((rows, cols), np.nan)
    empty3 = np.broadcast_to(np.nan, (rows, cols, 3))
    motion = dense is not None
    return Field(
        x_px=windows.xy_px[..., 0],
        y_px=windows.xy_px[..., 1],
        status=status,
        xyz_mm=xyz,
        normal_sys=empty3,
        theta_rad=empty,
        phi_rad=empty,
        zp_mm=empty,
        zncc=np.where(valid[..., None], windows.zncc, np.nan),
        epipolar_px=np.where(valid, windows.epipolar_px, np.nan),
        iterations=valid.astype(np.int32),
        noise_grey=noise,
        covariance=covariance,
        uvw_mm=values[..., 3:] if motion else None,
        rotation_rad=empty3 if motion else None,
        stretch=empty3 if motion else None,
        cuts=grid.cuts,
        dense=DenseRecord(
            step_px=step_px,
            window_px=options.subset_px,
            spacing_px=grid.spacing_px,
            variance_ratio=float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else float("nan"),
        ),
    )


def _keep_shape(covariance: Float, dense: Field, valid: Bool) -> None:
    """Give positions the shape's covariance where it is the larger one, as the ordinary field does; in place."""
    traces = [sum(c[..., k, k] for k in range(3)) for c in (dense.covariance, covariance)]
    with np.errstate(invalid="ignore"):
        larger = valid & (traces[0] > traces[1])
    covariance[larger, :3, :3] = dense.covariance[larger]


class _Limits:
    """What a vector must hold, from the field's own scatter and from the ordinary points about it."""

    def __init__(self, windows: Windows, misfit: Float, between: _Between, ordinary: Field) -> None:
        self.windows, self.misfit, self.between, self.ordinary = windows, misfit, between, ordinary
        self.step_px = _STEP_PX + _SD * _median(windows.moved_px, axis=(0, 1))
        part = slice(None)
        with np.errstate(invalid="ignore", divide="ignore"):
            louder = np.log(windows.misfit / between.of(misfit, part))
        self.louder = np.exp(np.clip(_SD * _scatter(louder), *np.log(_MISFIT)))
        off = windows.epipolar_px - between.of(ordinary.epipolar_px, part)
        self.offset_px = _OFFSET_PX + _SD * float(_scatter(off[..., None])[0])

    def failed(self, part: slice, noise: Float, options: MeasureOptions) -> NDArray[np.int8]:
        """Return the status of some rows' vectors by these limits; ``noise`` is the standard deviation for them."""
        w = self.windows
        out = np.zeros(w.status[part].shape, np.int8)
        with np.errstate(invalid="ignore"):
            off = np.abs(w.epipolar_px[part] - self.between.of(self.ordinary.epipolar_px, part))
            louder = w.misfit[part] > self.louder * self.between.of(self.misfit, part)
            checks = (
                (PointStatus.EPIPOLAR_MISMATCH, ~(off <= self.offset_px)),
                (PointStatus.NEIGHBOUR_MISMATCH, ~(w.moved_px[part] <= self.step_px).all(axis=-1)),
                (PointStatus.LOW_CORRELATION, ~(w.zncc[part] >= options.min_zncc).all(axis=-1) | louder.any(axis=-1)),
                (PointStatus.LOW_TEXTURE, ~(w.sigma_px[part] * noise <= options.validity.max_sigma_px)),
            )
        for status, where in checks:
            out[where] = status
        return out


def _median(values: Float, axis: tuple[int, int]) -> Float:
    return np.asarray(np.nanmedian(values, axis=axis) if np.isfinite(values).any() else np.zeros(values.shape[-1]))


def _scatter(values: Float) -> Float:
    """Robust standard deviation (k,) of values (r, c, k)."""
    if not np.isfinite(values).any():
        return np.zeros(values.shape[-1])
    return np.asarray(1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values, axis=(0, 1))), axis=(0, 1)))
