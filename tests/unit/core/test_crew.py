"""Fits that are shared out: every point is fitted once or more, by whoever, and comes to the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from core.errors import Cancelled
from core.field.points.crew import ToFit, fit_shared
from core.field.points.fitter import Fitter, PointFits
from core.field.points.tile import TileFits, TileSetting
from core.field.region.region import PointGrid
from core.matching.image import PAD, prepare
from core.matching.rows import prepare_rows, reference_rows
from core.measure import MeasureOptions, ReferencePair
from core.noise import NoiseModel
from core.progress import Cancel
from core.status import PointStatus
from tests.support import sequence_bench as bench

N = 1000


class Doubling(Fitter):
    """Fits whose result is twice the start."""

    def fit(self, xy_px: Any, w: Any, G: Any) -> PointFits:
        fits = PointFits.empty(len(xy_px), 1)
        fits.w[:], fits.status[:] = 2.0 * w, PointStatus.OK
        return fits

    def far_from_start(self, xy_px: Any, *_: Any) -> Any:
        return np.zeros(len(xy_px), bool)


class Others:
    """Others who take some tiles and finish some of them after a while, but for what left their part of the images."""

    def __init__(self, takes: set[int], finishes: set[int], after: int = 0) -> None:
        self.takes, self.finishes, self.after = takes, finishes, after
        self.claimed: list[int] = []
        self.asked = 0
        self.closed = False
        self.tiles: list[ToFit] = []

    def share(self, fitter: Fitter, tiles: list[ToFit]) -> Others:
        self.fitter, self.tiles = fitter, tiles
        return self

    def claim(self, k: int) -> bool:
        if k in self.takes:
            return False
        self.claimed.append(k)
        return True

    def fitted(self, k: int) -> PointFits | None:
        self.asked += 1
        if k not in self.finishes or self.asked <= self.after:
            return None
        fits = self.fitter.fit(self.tiles[k].xy_px, self.tiles[k].w, None)
        fits.reject(np.arange(len(fits.status)) % 10 == 0, PointStatus.LOW_TEXTURE)
        return fits

    def close(self) -> None:
        self.closed = True


def shared_out(others: Others, cancel: Cancel | None = None) -> PointFits:
    given: dict[str, Any] = dict.fromkeys(("pair", "ref1", "ref2", "cur1", "cur2", "options"))
    fitter = Doubling(**given, min_zncc=0.6, crew=others)
    start = np.arange(3.0 * N).reshape(N, 3)
    points = PointFits.empty(N, 1)
    for part, fits in fit_shared(fitter, ToFit(np.zeros((N, 2)), start, None, 3.0), cancel):
        points.put(np.arange(N)[part], fits)
    return points


@pytest.mark.parametrize(
    "others",
    [
        Others(set(), set()),
        Others({0, 1, 2}, {0, 1, 2}),
        Others({0, 1, 2}, {0, 2}),
        Others(set(range(16)), set()),
        Others(set(range(16)), set(range(16)), after=2),
    ],
    ids=["nobody", "some", "one dies", "all die", "slow"],
)
def test_whoever_fits_a_tile_every_point_comes_to_the_same(others: Others) -> None:
    points = shared_out(others)
    assert points.ok.all()
    np.testing.assert_array_equal(points.w, 2.0 * np.arange(3.0 * N).reshape(N, 3))
    assert others.closed
    assert set(others.claimed).isdisjoint(others.takes)
    assert sum(map(len, others.tiles)) == N
    assert len(others.tiles) == 16


def test_a_cancelled_step_wants_no_more_tiles() -> None:
    cancel, others = Cancel(), Others(set(), set())
    cancel.set()
    with pytest.raises(Cancelled):
        shared_out(others, cancel)
    assert others.closed


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 255, (300, 177)).astype(np.uint8)


@pytest.mark.parametrize("order", [3, 5])
@pytest.mark.parametrize(("first", "last"), [(0, 40), (100, 131), (251, 300), (0, 300)])
def test_some_rows_are_prepared_as_those_of_the_whole_image(
    pixels: np.ndarray, order: int, first: int, last: int
) -> None:
    whole = prepare(pixels, "cubic" if order == 3 else "quintic")
    part = prepare_rows(pixels, order, first, last).coefficients
    top, bottom = PAD + first - (PAD if first == 0 else 0), PAD + last + (PAD if last == 300 else 0)
    np.testing.assert_array_equal(part[top:bottom], whole.coefficients[top:bottom])
    if first > 0:
        assert np.isnan(part[top - 20 : top]).all()
    if last < 300:
        assert np.isnan(part[bottom : bottom + 20]).all()
    assert whole.slopes is not None
    reference = reference_rows(pixels, order, whole.slopes, first, last)
    for own, expected in zip(reference.gradients, whole.gradients, strict=True):
        np.testing.assert_array_equal(own[first:last], expected[first:last])
    np.testing.assert_array_equal(reference.pixels[first:last], whole.pixels[first:last])
    assert (reference.slope_noise, reference.slope_share) == (whole.slope_noise, whole.slope_share)


class WithImages:
    """Others who fit all tiles, with the rows of the images that these need."""

    def __init__(self, pixels: list[np.ndarray]) -> None:
        self.pixels, self.fitted_tiles = pixels, 0

    def share(self, fitter: Fitter, tiles: list[ToFit]) -> WithImages:
        setting = TileSetting.of(fitter)
        assert setting is not None
        self.fits, self.tiles = TileFits(fitter.pair, self.pixels, setting), tiles
        return self

    def claim(self, _k: int) -> bool:
        return False

    def fitted(self, k: int) -> PointFits:
        self.fitted_tiles += 1
        return self.fits.fit(self.tiles[k], None)

    def close(self) -> None:
        pass


def test_with_noise_models_too_a_tile_is_that_of_the_whole_images() -> None:
    images = [bench.capture(bench.plate(0.3 * n), seed=n) for n in range(2)]
    model = NoiseModel(coefficients=(2.0, 0.01, 0.0))
    options = MeasureOptions(subset_px=33, split_from=0, noise=(model, model))
    grid = PointGrid.rectangle(180, 170, 340, 310, spacing_px=8)
    crew = WithImages([*images[0], *images[1]])
    reference = ReferencePair(bench.rig().pair, *images[0])
    shape = reference.shape(grid, options)
    own, shared = (reference.motion(*images[1], grid, options, shape=shape, crew=one) for one in (None, crew))
    assert crew.fitted_tiles > 0
    for name in ("status", "uvw_mm", "zncc", "covariance", "noise_grey"):
        np.testing.assert_array_equal(getattr(shared, name), getattr(own, name))
