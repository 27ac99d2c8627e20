"""The dense windows against their numpy twin: the same vectors, covariances and correlations, for all lenses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.dense.windows import Windows, measure_windows, node_positions
from stereorig.core.errors import InputError
from stereorig.core.field.points.prediction import Prediction, predict
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.matching import MatchOptions, prepare
from stereorig.core.matching.geometry import covariance_xyz, covariance_xyzuvw, motion_geometry, shape_geometry
from stereorig.core.noise import NoiseModel
from stereorig.core.status import PointStatus
from tests.support.matching_scene import (
    Plane,
    Texture,
    digitise,
    opencv_pair,
    paper_pair,
    rational_pair,
    render,
    true_g,
    true_w,
)

PAIRS = {"seidel": lambda: paper_pair(kappa=2e-8), "opencv": opencv_pair, "rational": rational_pair}
AFTER = Plane(np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]))
SUBSET, SPACING = 17, 8


class Found(NamedTuple):
    """The windows' arrays under short names."""

    xy_px: NDArray
    values: NDArray
    covariance: NDArray
    epipolar_px: NDArray
    zncc: NDArray
    status: NDArray

    @staticmethod
    def of(windows: Windows) -> Found:
        f = windows.found
        return Found(windows.xy_px, f.values, f.covariance, f.epipolar, f.zncc, f.status)


class Scene:
    """Images of a moved plane, the lattice of an ordinary field, and a prediction some hundredths of a pixel off."""

    def __init__(self, kind: str) -> None:
        self.pair = PAIRS[kind]()
        texture = Texture(blob_mm=0.05 if kind == "seidel" else 0.11)
        rng = np.random.default_rng(5)
        images = [
            digitise(render(camera, plane, texture), noise=2.0, rng=rng)
            for plane in (Plane(), AFTER)
            for camera in (self.pair.cam1, self.pair.cam2)
        ]
        images[3] = np.clip(0.8 * images[3] + 20.0, 0, 255).astype(np.uint8)
        self.images = images
        x, y = np.meshgrid(44.0 + SPACING * np.arange(9), 52.0 + SPACING * np.arange(7))
        self.xy = np.stack([x, y], axis=-1)
        flat = self.xy.reshape(-1, 2)
        w, G = true_w(self.pair.cam1, Plane(), flat), true_g(self.pair.cam1, Plane(), AFTER, flat)
        self.state = np.concatenate([w[:, :1], G[:, :, 0], np.zeros((len(flat), 1))], axis=1).reshape(*x.shape, 5)
        true = node_positions(self.pair, self.xy, self.state, motion=True).reshape(-1, 6)
        self.bent = Bent.of(flat, true + np.array([0.02, -0.01, 0.015, 0.02, -0.02, 0.01]))

    def prediction(self, images: int) -> Prediction:
        rim = 2
        rows, cols = self.xy.shape[:2]
        x, y = np.meshgrid(
            self.xy[0, 0, 0] + SPACING * np.arange(-rim, cols + rim),
            self.xy[0, 0, 1] + SPACING * np.arange(-rim, rows + rim),
        )
        flat = np.stack([x.ravel(), y.ravel()], axis=-1)
        value, slope = self.bent.at(flat), self.bent.slopes(flat) * SPACING
        mixed = np.broadcast_to(self.bent.coefficients[4] * SPACING**2, value.shape)
        nodes = np.stack([value, slope[..., 0], slope[..., 1], mixed], axis=-1).reshape(*x.shape, 6, 4)
        return Prediction(
            nodes[:, :, : 2 * images].copy(),
            np.ones(np.subtract(x.shape, 1), bool),
            np.ones((rows - 1, cols - 1), bool),
            rim,
        )

    def measured(self, images: int, interpolation: str, step: int = 2, **more: object) -> Found:
        options = MatchOptions(subset_px=SUBSET, interpolation=interpolation)  # type: ignore[arg-type]
        shown = [prepare(image, interpolation) for image in self.images[: images + 1]]  # type: ignore[arg-type]
        given = {"cuts": None, "white": None} | more
        return Found.of(measure_windows(
            self.pair, shown, self.xy, self.state, self.prediction(images), options, step_px=step, **given
        ))  # type: ignore[arg-type]  # fmt: skip


@pytest.fixture(scope="module", params=PAIRS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


@pytest.fixture(scope="module")
def one() -> Scene:
    """A scene for what does not depend on the lens."""
    return Scene("seidel")


@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
@pytest.mark.parametrize("images", [1, 3])
def test_a_vector_is_the_twins(scene: Scene, images: int, interpolation: str, order: int) -> None:
    found = scene.measured(images, interpolation)
    assert (found.status == PointStatus.OK).all()
    twin = DenseTwin(scene.pair, scene.images[: images + 1], scene.bent, subset=SUBSET, order=order)
    entries = np.triu_indices(3 if images == 1 else 6)
    for r, c in ((0, 0), (5, 11), (13, 17), (24, 32)):
        xy = found.xy_px[r, c]
        true = twin.vector(xy, np.array([*scene.state[r // 4, c // 4, :4], 0.0]))
        sigma = np.sqrt(np.diagonal(true.covariance))
        # float32 pixels and places: some 1e-5 px, a thousandth of the standard deviation at noise 2
        assert np.abs((found.values[r, c] - true.values) / sigma).max() < 5e-3
        assert abs(found.epipolar_px[r, c] - true.epipolar_px) < 5e-5
        assert np.abs(found.zncc[r, c] - true.zncc).max() < 1e-6
        scale = np.outer(sigma, sigma)[entries]
        assert np.abs((found.covariance[r, c] - true.covariance[entries]) / scale).max() < 2e-3


@pytest.mark.parametrize("step", [1, 3, 5])
def test_each_step_has_the_same_vectors_where_they_meet(one: Scene, step: int) -> None:
    every, some = one.measured(3, "quintic", step=1), one.measured(3, "quintic", step=step)
    np.testing.assert_allclose(some.xy_px, every.xy_px[::step, ::step])
    # running sums: their rounding is all that differs
    np.testing.assert_allclose(some.values, every.values[::step, ::step], rtol=0.0, atol=1e-8)


def test_no_window_touches_a_cut_or_black(one: Scene) -> None:
    line = np.array([(40.0, 74.4), (125.0, 81.7)])
    white = np.ones(one.images[0].shape, bool)
    white[:, 101:] = False
    found = one.measured(3, "quintic", cuts=Cuts([line]), white=white)
    x, y = found.xy_px[..., 0], found.xy_px[..., 1]
    half = SUBSET // 2
    low, high = np.interp(x - half, *line.T), np.interp(x + half, *line.T)
    clear = ((y + half < low - 4.5) | (y - half > high + 4.5)) & (x + half < 101)
    meets = (y + half > low) & (y - half < high) | (x + half >= 101)
    assert (found.status[meets] == PointStatus.MASKED).all()
    assert (found.status[clear] == PointStatus.OK).all()
    assert np.isnan(found.values[meets]).all()
    untouched = one.measured(3, "quintic")
    np.testing.assert_allclose(found.values[clear], untouched.values[clear], rtol=0.0, atol=1e-8)


def test_a_window_beyond_another_image_is_outside(one: Scene) -> None:
    away = one.prediction(3)
    away.nodes[..., 4, 0] += 60.0  # camera 2's current image, along x
    shown = [prepare(image) for image in one.images]
    options = MatchOptions(subset_px=SUBSET)
    found = Found.of(
        measure_windows(one.pair, shown, one.xy, one.state, away, options, step_px=4, cuts=None, white=None)
    )
    size = one.images[3].shape[1]
    beyond = found.xy_px[..., 0] + 60.0 > size
    assert beyond.any()
    assert (found.status[beyond] == PointStatus.OUTSIDE_IMAGE).all()


def test_a_louder_image_weighs_less(one: Scene) -> None:
    even = one.measured(3, "quintic")
    options = MatchOptions(subset_px=SUBSET)
    models = [NoiseModel(coefficients=(v, 0.0, 0.0)) for v in (4.0, 4.0, 4.0, 400.0)]
    shown = [prepare(image, noise=model) for image, model in zip(one.images, models, strict=True)]
    loud = Found.of(
        measure_windows(
            one.pair, shown, one.xy, one.state, one.prediction(3), options, step_px=4, cuts=None, white=None
        )
    )
    # variances are for noise of variance 1 without a model, in (grey levels)^2 with one
    ratio = loud.covariance / even.covariance[::2, ::2]
    assert (ratio[..., [0, 6, 11]] > 3.9).all()  # positions: of the reference pair, whose variance is 4
    assert (ratio[..., [15, 18, 20]] > 30.0).all()
    assert (ratio[..., [15, 18, 20]] < 410.0).all()


class PredictionTests:
    """Where a prediction is, and what it is."""

    X, Y = np.meshgrid(30.0 + 10.0 * np.arange(24), 40.0 + 10.0 * np.arange(20))
    XY = np.stack([X, Y], axis=-1)
    SMOOTH = np.stack([1.01 * X + 2e-4 * X * Y, 0.98 * Y - 1e-4 * X**2], axis=-1)

    def test_a_quadratic_is_predicted_exactly_and_beyond_the_points(self) -> None:
        made = predict(self.XY, self.SMOOTH, np.ones(self.X.shape, bool), None, subset_px=33)
        assert made.rim == 2
        assert made.seen.all()
        assert made.cells.all()
        x, y = np.meshgrid(30.0 + 10.0 * np.arange(-2, 26), 40.0 + 10.0 * np.arange(-2, 22))
        np.testing.assert_allclose(made.nodes[..., 0, 0], 1.01 * x + 2e-4 * x * y, atol=1e-7)
        np.testing.assert_allclose(made.nodes[..., 0, 1], 10.0 * (1.01 + 2e-4 * y), atol=1e-7)
        np.testing.assert_allclose(made.nodes[..., 1, 1], -10.0 * 2e-4 * x, atol=1e-7)
        np.testing.assert_allclose(made.nodes[..., 0, 3], 100.0 * 2e-4, atol=1e-7)

    def test_no_vector_lies_between_points_on_both_sides_of_a_jump(self) -> None:
        jump = self.SMOOTH.copy()
        jump[:, 12:, 1] += 0.5
        made = predict(self.XY, jump, np.ones(self.X.shape, bool), None, subset_px=33)
        assert not made.cells[:, 11].any()
        left, right = made.cells[:, :8], made.cells[:, 15:]
        assert left.all()
        assert right.all()

    def test_it_ends_between_two_parts_that_do_not_continue_each_other(self) -> None:
        measured = np.ones(self.X.shape, bool)
        measured[:, 11:14] = False
        jump = self.SMOOTH.copy()
        jump[:, 12:, 1] += 0.5
        made = predict(self.XY, np.where(measured[..., None], jump, np.nan), measured, None, subset_px=33)
        assert not made.seen[:, made.rim + 10 : made.rim + 14].all(axis=1).any()
        closed = predict(self.XY, np.where(measured[..., None], self.SMOOTH, np.nan), measured, None, subset_px=33)
        assert closed.seen.all()
        assert not closed.cells[:, 10:14].any()

    def test_unmeasured_points_have_no_vectors_about_them(self) -> None:
        measured = np.ones(self.X.shape, bool)
        measured[9, 12] = False
        made = predict(self.XY, np.where(measured[..., None], self.SMOOTH, np.nan), measured, None, subset_px=33)
        off = ~made.cells
        assert off.sum() == 4
        assert off[8:10, 11:13].all()


def test_a_step_that_is_no_denser_is_refused() -> None:
    from stereorig.core.dense.field import _check
    from stereorig.core.field.region.region import PointGrid

    grid = PointGrid.rectangle(40.0, 40.0, 90.0, 90.0, spacing_px=5.0)
    with pytest.raises(InputError, match="at most the points' spacing") as told:
        _check(grid, 6)
    assert told.value.code == "dense_step_invalid"


# Plain numpy twin of the dense windows: sums over each window's own pixels, without haste.
#
# It shares nothing with the kernels: splines by ``ndimage``, the prediction as the polynomials that it was made of,
# the cameras through their own functions with derivatives by differences, and the geometry of the ordinary fit.

_STEPS = np.array([1e-8, 1e-6, 1e-6, 1e-6, 1e-3])


@dataclass(frozen=True)
class Bent:
    """Image coordinates (m,) as polynomials over a pixel's place: 1, x, y, x^2, x y, y^2 about ``middle``."""

    coefficients: NDArray
    middle: NDArray

    @staticmethod
    def of(xy: NDArray, positions: NDArray) -> Bent:
        """Fit positions (n, m) at places (n, 2)."""
        middle = xy.mean(axis=0)
        return Bent(np.linalg.lstsq(_terms(xy - middle), positions, rcond=None)[0], middle)

    def at(self, xy: NDArray) -> NDArray:
        """Positions (n, m)."""
        return _terms(xy - self.middle) @ self.coefficients

    def slopes(self, xy: NDArray) -> NDArray:
        """Derivatives (n, m, 2)."""
        h = 1e-3
        return np.stack([(self.at(xy + d) - self.at(xy - d)) / (2 * h) for d in np.eye(2) * h], axis=-1)


def _terms(d: NDArray) -> NDArray:
    x, y = d[:, 0], d[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


@dataclass(frozen=True)
class Vector:
    """One vector: position and displacement, their covariance for noise of variance 1, and the correlations."""

    values: NDArray
    covariance: NDArray
    epipolar_px: float
    zncc: NDArray


class DenseTwin:
    """The images of a shape (2) or a motion (4), and the prediction."""

    def __init__(self, pair: StereoPair, images: list[NDArray], prediction: Bent, *, subset: int, order: int) -> None:
        self.pair, self.prediction, self.order, self.half = pair, prediction, order, subset // 2
        self.images = [np.asarray(image, float) for image in images]
        self.splines = [spline_filter(image, order, mode="mirror") for image in self.images]
        self.gradients = prepare(images[0], "cubic" if order == 3 else "quintic").gradients

    def project(self, xy: NDArray, state: NDArray) -> NDArray:
        """Pixels (2 m,) of a point with unknowns (w, G0, e) in the other images."""
        pair, count = self.pair, len(self.images) - 1
        ray = pair.cam1.rays_cam(xy).xyz_mm
        R, t = pair.cam2_from_cam1.rotation, pair.cam2_from_cam1.translation_mm
        a, b = (pair.image2_at_depth(xy, z) for z in (1.0001 / state[0], 0.9999 / state[0]))
        along = (a - b) / np.linalg.norm(a - b)
        across = np.array([-along[1], along[0]])
        if pair.epipolar_residual_px(xy, a + across) < 0:
            across = -across
        out = []
        for k in range(count):
            q = ray if k == 0 else state[1:4]
            if k != 1:
                q = R @ q + t * state[0]
            lens = pair.cam1.lens if k == 1 else pair.cam2.lens
            at = lens.image_from_normalised(q[None, :2] / q[2]).xy[0]
            out.append(at if k == 1 else at + state[4] * across)
        return np.concatenate(out)

    def vector(self, xy: NDArray, state: NDArray) -> Vector:
        """Measure one vector; ``state`` (5,) is near its solution."""
        count = len(self.images) - 1
        side = np.arange(-self.half, self.half + 1)
        x, y = np.meshgrid(np.floor(xy[0] + 0.5) + side, np.floor(xy[1] + 0.5) + side)
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
        cols, rows = pixels.astype(int).T
        f = self.images[0][rows, cols]
        f = f - f.mean()
        J = np.stack([g[rows, cols] for g in self.gradients], axis=-1).astype(float)
        J -= J.mean(axis=0)
        free = J - np.outer(f, f @ J) / (f @ f)  # gain taken out too
        N = free.T @ free
        C = np.linalg.inv(N)
        places = self.prediction.at(pixels)
        here, slopes = self.prediction.at(xy[None])[0], self.prediction.slopes(xy[None])[0]
        measured, contrast, density, zncc = [], [], [], []
        for k in range(count):
            g = map_coordinates(
                self.splines[k + 1], places[:, [2 * k + 1, 2 * k]].T, order=self.order, mode="mirror", prefilter=False
            )
            g = g - g.mean()
            scale = np.sqrt((g @ g) / (f @ f))
            left = g / scale - f
            moved = -C @ (J.T @ left)
            left = left @ left - moved @ N @ moved
            A = slopes[2 * k : 2 * k + 2]
            measured.append(here[2 * k : 2 * k + 2] + A @ moved)
            contrast.append(scale)
            density.append(abs(np.linalg.det(A)))
            zncc.append(1.0 - 0.5 * left / (f @ f))
        V = np.diag(1.0 / (np.array(contrast) ** 2 * density)) + 1.0
        A = np.zeros((2 * count, 2 * count))
        for k in range(count):
            A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = slopes[2 * k : 2 * k + 2]
        of_pixels = A @ np.kron(V, C) @ A.T
        unknowns = [0, 4] if count == 1 else [0, 1, 2, 3, 4]
        state = state.copy()
        for _ in range(3):
            B = np.stack(
                [
                    (self.project(xy, state + d) - self.project(xy, state - d)) / (2 * d.max())
                    for d in np.diag(_STEPS)[unknowns]
                ],
                axis=-1,
            )
            W = np.linalg.inv(of_pixels)
            cov = np.linalg.inv(B.T @ W @ B)
            state[unknowns] += cov @ (B.T @ W @ (np.concatenate(measured) - self.project(xy, state)))
        w = np.array([[state[0], 0.0, 0.0]])
        at = shape_geometry(self.pair, xy[None], w).xyz_mm[0]
        if count == 1:
            return Vector(at, covariance_xyz(self.pair, xy[None], w, cov[None])[0], state[4], np.array(zncc))
        G = np.zeros((1, 3, 3))
        G[0, :, 0], G[0, 0, 1], G[0, 1, 2] = state[1:4], 1.0, 1.0
        uvw = motion_geometry(self.pair, xy[None], w, G).uvw_mm[0]
        both = covariance_xyzuvw(self.pair, xy[None], w, G, cov[None])[0]
        return Vector(np.concatenate([at, uvw]), both, state[4], np.array(zncc))
