"""The dense windows against their numpy twin: the same vectors, covariances and correlations, for all lenses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.dense.prediction import Prediction, predict
from stereorig.core.dense.windows import Windows, measure_windows, node_positions
from stereorig.core.errors import InputError
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.matching import MatchOptions, prepare
from stereorig.core.noise import NoiseModel
from stereorig.core.status import PointStatus
from tests.support.dense_twin import Bent, DenseTwin
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
