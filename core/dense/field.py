"""A dense field: a vector every few pixels, from an ordinary field and the images that it was measured on.

The ordinary field, with all its checks, is the prediction. Each vector is one Gauss-Newton step from it over the whole
window about the vector, with offset and gain taken out, in the three comparisons of the ordinary fit; their joint
covariance weighs them, and the exact cameras turn them into a position and a displacement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.dense.kernels.finish import AtPoints, Limits, Shape
from stereorig.core.dense.windows import Windows, finish_windows, measure_windows, node_positions
from stereorig.core.errors import InputError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.prediction import predict
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import DenseRecord
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.arguments import own
from stereorig.core.settings import DENSE_STEP_PX, single_sigma_px
from stereorig.core.status import PointStatus

_SD = 6.0  # robust standard deviations
_MISFIT = (2.0, 6.0)  # least and largest limit on a residual, over the residual of the points about it
_STEP_PX = 0.05  # an increment beyond it and six times the field's median is no small step from the prediction
_OFFSET_PX = 0.01
_SAMPLE = 4  # the scatter is estimated from every fourth vector along both axes


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
        Points and settings of the ordinary shape's measurement.
    step_px
        Distance of vectors; at most the distance of the ordinary points.

    Returns
    -------
    Field
        Field with ``(n - 1) spacing / step + 1`` vectors along each axis, the first on the first ordinary point.
        Vectors are between four valid points of one smooth part whose windows meet no cut; elsewhere ``status`` is
        ``MASKED``. Normals, angles, rotation and stretch are not measured: NaN.

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
        As :func:`dense_shape`; ``dense_needs_first_reference`` if the step was matched against a later reference;
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
    if dense is not None and dense.shape != windows.xy_px.shape[:2]:
        raise InputError(
            f"the dense shape has {dense.shape} vectors, the displacement {windows.xy_px.shape[:2]}.",
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


def _field(
    windows: Windows, ordinary: Field, dense: Field | None, grid: PointGrid, options: MeasureOptions, step_px: int
) -> Field:
    """Check the vectors and give them their covariance."""
    found = windows.found
    points = _at_points(windows, ordinary, step_px / grid.spacing_px)
    limits = _limits(windows, points, options)
    if dense is None:
        none = np.empty((0, 0))
        shape = Shape(np.empty((0, 0), np.int8), none[..., None], none[..., None, None])
    else:
        shape = Shape(np.ascontiguousarray(dense.status), own(dense.xyz_mm), own(dense.covariance))
    known = points.ratio[np.isfinite(points.ratio)]
    ratio = float(np.median(known)) if known.size else None
    covariance, noise = finish_windows(windows, points, limits, shape)
    valid = found.status == PointStatus.OK
    nothing = np.broadcast_to(np.nan, valid.shape)
    nothing3 = np.broadcast_to(np.nan, (*valid.shape, 3))
    motion = dense is not None
    return Field(
        x_px=windows.xy_px[..., 0],
        y_px=windows.xy_px[..., 1],
        status=found.status,
        xyz_mm=found.values[..., :3],
        normal_sys=nothing3,
        theta_rad=nothing,
        phi_rad=nothing,
        zp_mm=nothing,
        zncc=found.zncc,
        epipolar_px=found.epipolar,
        iterations=valid.astype(np.int32),
        noise_grey=noise,
        covariance=covariance,
        uvw_mm=found.values[..., 3:] if motion else None,
        rotation_rad=nothing3 if motion else None,
        stretch=nothing3 if motion else None,
        cuts=grid.cuts,
        dense=DenseRecord(
            step_px=step_px, window_px=options.subset_px, spacing_px=grid.spacing_px, variance_ratio=ratio
        ),
    )


def _at_points(windows: Windows, ordinary: Field, step: float) -> AtPoints:
    """Values from the ordinary points for the vectors between them; ``step`` is vectors' over points' distance."""
    found = windows.found
    n = found.values.shape[2]
    nearest = np.ix_(*(
        np.minimum(np.rint(np.arange(nodes) / step).astype(int), vectors - 1)
        for nodes, vectors in zip(ordinary.shape, found.status.shape, strict=True)
    ))  # fmt: skip
    # ratio of the ordinary field's variance to the normal equations', for positions and for displacements
    diagonal = [k * n - k * (k - 1) // 2 for k in range(n)]
    here = found.covariance[nearest][..., diagonal].astype(np.float64)
    theirs = np.diagonal(ordinary.covariance, axis1=2, axis2=3)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.stack(
            [theirs[..., k : k + 3].sum(axis=-1) / here[..., k : k + 3].sum(axis=-1) for k in range(0, n, 3)], axis=-1
        )
    return AtPoints(
        ratio=_without_gaps(ratio),
        misfit=_without_gaps(found.misfit[nearest].astype(np.float64)),
        epipolar=_without_gaps(ordinary.epipolar_px[..., None]),
        noise=_without_gaps(ordinary.noise_grey[..., None]),
        step=step,
    )


def _without_gaps(values: Float) -> Float:
    """Values (r, c, k) with gaps filled by the field's median, at least two rows and columns."""
    known = np.isfinite(values)
    if not known.all():
        values = np.where(known, values, np.nanmedian(values, axis=(0, 1)) if known.any() else np.nan)
    more = [(0, max(2 - size, 0)) for size in values.shape[:2]]
    return np.ascontiguousarray(np.pad(values, (*more, (0, 0)), mode="edge"))


def _limits(windows: Windows, points: AtPoints, options: MeasureOptions) -> Limits:
    """Limits for a vector, from the field's own scatter and from the ordinary points about it, by a sample."""
    found = windows.found
    rows, cols = (np.arange(0, size, _SAMPLE) for size in found.status.shape)
    there = np.ix_(rows, cols)
    at = np.rint(rows * points.step).astype(int), np.rint(cols * points.step).astype(int)
    near = np.ix_(*(np.minimum(a, size - 1) for a, size in zip(at, points.noise.shape, strict=False)))
    with np.errstate(invalid="ignore", divide="ignore"):
        louder = np.log(found.misfit[there] / points.misfit[near])
        off = (found.epipolar[there] - points.epipolar[near][..., 0])[..., None]
    moved = found.moved[there]
    return Limits(
        zncc=options.min_zncc,
        sigma=single_sigma_px(options.validity.max_sigma_px),
        moved=_STEP_PX + _SD * float(np.nanmedian(moved)) if np.isfinite(moved).any() else _STEP_PX,
        offset=_OFFSET_PX + _SD * float(_scatter(off)[0]),
        louder=np.exp(np.clip(_SD * _scatter(louder), *np.log(_MISFIT))).astype(np.float64),
    )


def _scatter(values: Float) -> Float:
    """Robust standard deviation (k,) of values (r, c, k)."""
    if not np.isfinite(values).any():
        return np.zeros(values.shape[-1])
    return np.asarray(1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values, axis=(0, 1))), axis=(0, 1)))
