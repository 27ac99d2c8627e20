"""Measurement of frames in sequence: each point starts from its last place, moved on by the field's smooth velocity.

From such a start one step of the fit is enough. The remaining error is a share of the motion; points that moved
further, as after a turn of the motion, take another step. The share is learned from these points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.validity import check_neighbours, disagreement_scale
from stereorig.core.field.growth.state import SAMPLE_FAR_PX, prepare
from stereorig.core.field.points.fitter import PointFits, learned_rate
from stereorig.core.field.points.images import MeasureImage, refuse_stale, same_size
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import Starts, image_positions
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.live.converted import Constant, convert
from stereorig.core.matching.arguments import flat, given_to_kernels, one_a_thread, run_kernel, setting_of
from stereorig.core.matching.image import Box, ImageData, prepare_part
from stereorig.core.matching.kernels.drivers import run_points, work_space
from stereorig.core.matching.kernels.given import Given
from stereorig.core.matching.kernels.motion import n_motion_out
from stereorig.core.matching.options import SPLINE_ORDER
from stereorig.core.measure import ReferencePair
from stereorig.core.status import PointStatus
from stereorig.core.threads import run_ranges

_SMOOTH_FROM = 24  # points, for a velocity of second order
_AROUND_PX = 8  # about a subset: its way, its taps, and rounding
_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Followed:
    """A followed frame: its field, and the share of a step's motion that is left to be made, as its points show it."""

    field: Field
    rate: float


@dataclass(eq=False)
class _Fits:
    """Numbers of m points after a fit."""

    out: Float
    status: NDArray[np.int8]
    iterations: NDArray[np.int32]
    uvw: Float
    covariance: Float


class Follower:
    """Measures frames at the points of the frame before.

    Quantities that depend on the reference alone are computed once.

    Parameters
    ----------
    reference, shape, grid, options
        The reference pair and its shape, points with their visibility, and settings without a blur.

    Raises
    ------
    RegionError, ImageError
        As :func:`stereorig.core.measure.measure_shape`.
    """

    def __init__(self, reference: ReferencePair, shape: Field, grid: PointGrid, options: MeasureOptions) -> None:
        self._reference, self._shape, self._options = reference, shape, options
        inputs = prepare(reference.pair, (reference.image1, reference.image2), None, grid, options)
        self._inputs = inputs = inputs.on_shape(shape, None)
        self._index = index = np.flatnonzero(inputs.usable)
        self._xy = inputs.xy_px[index]
        assert shape.starts is not None
        depth = shape.starts.w.reshape(len(inputs.xy_px), -1)[:, 0]
        self._constant = Constant.of(
            self._pair,
            inputs.rays[index],
            depth[index],
            shape.covariance.reshape(-1, *shape.covariance.shape[2:])[index][:, :3, :3],
            min_zncc=options.min_zncc,
            far_px=SAMPLE_FAR_PX,
        )
        self._scale = disagreement_scale(self._pair, inputs.rays, depth)
        self._given: dict[int, Given] = {}
        # kept from frame to frame: the points' partly visible subsets are always the same
        self._spaces = {d: one_a_thread(make, options.subset_px) for d, make in work_space["motion"].items()}
        self._around: tuple[object, tuple[float, float]] | None = None  # for one patch choice
        self._smoothing: tuple[Bool | None, Float] = None, np.zeros((0, 0))
        middle, width = self._xy.mean(axis=0), np.maximum(np.ptp(self._xy, axis=0), 1.0)
        x, y = ((self._xy - middle) / width).T
        self._design = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)

    @property
    def _pair(self) -> StereoPair:
        return self._reference.pair

    def measure(
        self,
        images: tuple[MeasureImage, MeasureImage],
        previous: Field,
        before: tuple[Field, float] | None,
        ratio: Float,
        rate: float | None,
    ) -> Followed:
        """Measure a frame.

        Parameters
        ----------
        images
            Both cameras' images.
        previous
            The frame before it.
        before
            The frame before that, and the time since the previous one over the time between these two; without it the
            points start from their last places.
        ratio
            (r, c, 6) standard deviations with all checks over a fit's own.
        rate
            Share of its motion that a step leaves, as the frame before had it; None: not known yet.

        Raises
        ------
        ImageError
            ``image_size_mismatch``, ``stale_image``.
        """
        references = self._inputs.ref1, self._inputs.ref2
        for reference, image in zip(references, images, strict=True):
            same_size(reference, image)
        refuse_stale(*references, *images)
        assert previous.starts is not None
        assert previous.starts.G is not None
        terms = previous.starts.w.shape[-1]
        had = previous.valid.ravel()[self._index]
        w = previous.starts.w.reshape(-1, terms)[self._index]
        G = previous.starts.G.reshape(-1, 3, terms)[self._index]
        if before is not None and before[0].starts is not None and before[0].starts.G is not None:
            was = before[0].starts.G.reshape(self._inputs.xy_px.shape[0], 3, -1)[self._index]
            if was.shape == G.shape:
                G = G + before[1] * self._smooth(G - was)
        current = self._prepared(images, previous, w, G)
        given = self._given_for(terms, current)._replace(w=w, G=G)
        ratio = ratio.reshape(-1, 6)[self._index]
        fits = self._fitted(given, current, had, w, G, ratio, rate)
        rates = fits.out[had & (fits.status == PointStatus.OK), -1]
        learned = learned_rate(rates, rate, self._inputs.matcher.options)
        return Followed(self._field(fits, terms, had, previous), learned)

    def _fitted(
        self,
        given: Given,
        current: tuple[ImageData, ImageData],
        had: Bool,
        w: Float,
        G: Float,
        ratio: Float,
        rate: float | None,
    ) -> _Fits:
        (m, terms), matcher = w.shape, self._inputs.matcher
        options = matcher.options if rate is None else replace(matcher.options, first_rate=rate)
        if terms == 6:
            options = replace(options, patch="quadratic")
        given = given._replace(setting=setting_of(options, [matcher.ref1, matcher.ref2, *current]))
        degree = 2 if terms == 6 else 1
        out = np.full((m, n_motion_out(terms)), np.nan)
        status, iterations = run_kernel(
            run_points["motion"][degree],
            work_space["motion"][degree],
            given,
            out,
            kept_space=self._spaces[degree],
            at_once=_AT_ONCE,
        )
        status[~had] = PointStatus.NOT_SEEDED
        uvw, covariance = np.full((m, 3), np.nan), np.full((m, 6, 6), np.nan)
        arrays = (
            self._constant,
            terms,
            out,
            np.ascontiguousarray(w),
            np.ascontiguousarray(G),
            np.ascontiguousarray(ratio),
            status,
            uvw,
            covariance,
        )
        run_ranges(lambda first, last: convert(first, last, *arrays), m, _AT_ONCE)
        return _Fits(out, status, iterations, uvw, covariance)

    def _given_for(self, terms: int, current: tuple[ImageData, ImageData]) -> Given:
        matcher = self._inputs.matcher
        if terms not in self._given:
            options = replace(matcher.options, patch="quadratic") if terms == 6 else matcher.options
            visibility = self._inputs.visibility
            visible = None if visibility is None else visibility.at(self._xy)
            m = len(self._xy)
            self._given[terms] = given_to_kernels(
                self._pair,
                [matcher.ref1, matcher.ref2, *current],
                self._xy,
                np.zeros((m, terms)),
                options,
                visible,
                G=np.zeros((m, 3, terms)),
            )
        given = self._given[terms]
        return given._replace(images=(given.images[0], *(flat(image) for image in current)))

    def _smooth(self, velocity: Float) -> Float:
        """Return a velocity (m, ...) without the points' noise: second order over the image."""
        each = velocity.reshape(len(velocity), -1)
        known = np.isfinite(each[:, 0])
        n = int(known.sum())
        if n == 0:
            return np.zeros_like(velocity)
        if self._smoothing[0] is None or not np.array_equal(self._smoothing[0], known):
            columns = self._design.shape[1] if n >= _SMOOTH_FROM else 1
            self._smoothing = known, np.linalg.pinv(self._design[known, :columns], rcond=1e-6)
        found = self._smoothing[1] @ each[known]
        return (self._design[:, : len(found)] @ found).reshape(velocity.shape)

    def _prepared(
        self, images: tuple[MeasureImage, MeasureImage], previous: Field, w: Float, G: Float
    ) -> tuple[ImageData, ImageData]:
        """Find the coefficients about the points."""
        boxes = self._boxes(previous, w, G)
        order = SPLINE_ORDER[self._options.interpolation]
        found: dict[int, ImageData] = {}

        def prepare_some(first: int, last: int) -> None:
            for k in range(first, last):
                noise = images[k].noise if self._options.noise[k] is None else self._options.noise[k]
                found[k] = prepare_part(images[k].pixels, order, noise, boxes[k])

        run_ranges(prepare_some, 2, 1)
        return found[0], found[1]

    def _boxes(self, previous: Field, w: Float, G: Float) -> tuple[Box, Box]:
        # computed again at each frame that is measured as a step
        if self._around is None or self._around[0] is not previous.patch:
            self._around = previous.patch, self._reach_px(w, G)
        boxes = []
        for positions, reach, image in zip(
            image_positions(self._pair, w, G[:, :, 0]),
            self._around[1],
            (self._inputs.ref1, self._inputs.ref2),
            strict=True,
        ):
            rows, cols = image.shape
            along = np.ascontiguousarray(positions.T)  # a minimum over rows of two takes ten times as long
            low, high = np.fmin.reduce(along, axis=1) - reach, np.fmax.reduce(along, axis=1) + reach
            x0, y0 = np.clip(np.floor(np.nan_to_num(low)), 0, [cols - 1, rows - 1]).astype(int)
            x1, y1 = np.clip(np.ceil(np.nan_to_num(high)) + 1, [x0 + 1, y0 + 1], [cols, rows]).astype(int)
            boxes.append((int(x0), int(y0), int(x1), int(y1)))
        return boxes[0], boxes[1]

    def _reach_px(self, w: Float, G: Float) -> tuple[float, float]:
        """Distance from a point to the corners of its subset in both images, the way of a fit and its taps."""
        half = 0.5 * self._options.subset_px / self._constant.scale
        middle = image_positions(self._pair, w, G[:, :, 0])
        reach = [0.0, 0.0]
        for across in (-1.0, 1.0):
            for down in (-1.0, 1.0):
                shift = np.stack([across * half, down * half], axis=1)
                corner = G[:, :, 0] + np.einsum("mij,mj->mi", G[:, :, 1:3], shift)
                depth = w[:, :1] + (w[:, 1:3] * shift).sum(axis=1, keepdims=True)
                for k, there in enumerate(image_positions(self._pair, depth, corner)):
                    reach[k] = max(reach[k], float(np.nanmax(np.abs(there - middle[k]))))
        return reach[0] + SAMPLE_FAR_PX + _AROUND_PX, reach[1] + SAMPLE_FAR_PX + _AROUND_PX

    def _field(self, fits: _Fits, terms: int, had: Bool, previous: Field) -> Field:
        """Return the field, points that disagree with their neighbours taken out."""
        n, index, at = len(self._inputs.xy_px), self._index, 4 * terms
        ok = fits.status == PointStatus.OK

        def over_grid(values: Float) -> Float:
            out = np.full((n, *values.shape[1:]), np.nan)
            out[index[ok]] = values[ok]
            return out

        status = previous.status.ravel().copy()
        status[index[had]] = fits.status[had]
        iterations = np.zeros(n, np.int32)
        iterations[index] = fits.iterations
        points = PointFits(
            w=over_grid(fits.out[:, :terms]),
            G=over_grid(fits.out[:, terms:at]).reshape(n, 3, terms),
            zncc=over_grid(fits.out[:, at + 1 : at + 4]),
            epipolar_px=over_grid(fits.out[:, at]),
            epipolar_sigma_px=np.full(n, np.nan),
            noise=over_grid(fits.out[:, at + 4]),
            covariance=np.empty((n, 0, 0)),  # the field's is made already
            iterations=iterations,
            status=status,
            rate=np.full(n, np.nan),
        )
        inputs = self._inputs
        check_neighbours(
            points, inputs.pair, inputs.grid.shape, inputs.rays, self._options.validity, inputs.visibility, self._scale
        )
        uvw, covariance = over_grid(fits.uvw), over_grid(fits.covariance)
        lost = ~points.ok
        uvw[lost], covariance[lost] = np.nan, np.nan
        points.zncc[lost], points.noise[lost] = np.nan, np.nan
        iterations[lost] = 0
        shape, (rows, cols) = self._shape, self._shape.shape
        gone = lost.reshape(rows, cols)

        def of_shape(values: Float) -> Float:
            return np.where(gone[..., None] if values.ndim == 3 else gone, np.nan, values)

        return Field(
            x_px=shape.x_px,
            y_px=shape.y_px,
            status=status.reshape(rows, cols),
            xyz_mm=of_shape(shape.xyz_mm),
            normal_sys=of_shape(shape.normal_sys),
            theta_rad=of_shape(shape.theta_rad),
            phi_rad=of_shape(shape.phi_rad),
            zp_mm=of_shape(shape.zp_mm),
            zncc=points.zncc.reshape(rows, cols, -1),
            epipolar_px=points.epipolar_px.reshape(rows, cols),
            iterations=iterations.reshape(rows, cols),
            noise_grey=points.noise.reshape(rows, cols),
            covariance=covariance.reshape(rows, cols, 6, 6),
            uvw_mm=uvw.reshape(rows, cols, 3),
            patch=previous.patch,
            cuts=inputs.grid.cuts,
            starts=Starts(points.w.reshape(rows, cols, terms), points.G.reshape(rows, cols, 3, terms)),
        )
