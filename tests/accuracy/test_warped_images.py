"""Points measured on images warped once along a prediction are those of their own fits."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from stereorig.core.field.growth import warped
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.support.localised_strain import Motion, Strained, kink
from tests.support.matching_scene import Texture, digitise, paper_pair, render

SIZE = 230
TEXTURE = Texture(extent_mm=6.0)
GRID = PointGrid.rectangle(20, 20, SIZE - 21, SIZE - 21, spacing_px=5)
PAIRS = {"paper": paper_pair(size=SIZE), "distorted": paper_pair(size=SIZE, kappa=1e-6)}
SHIFT = (0.004, -0.003, 0.005)  # mm a step: about a tenth of a pixel


def even(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 0.01 * a + 0.004 * b, -0.003 * b - 0.002 * a


MOTIONS: dict[str, Motion] = {"even": even, "kink": kink(0.03)}


def state(motion: str, step: int) -> Strained:
    """The plate after ``step`` equal steps of a motion."""
    if step == 0:
        return Strained()

    def part(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = MOTIONS[motion](a, b)
        return step / 3.0 * u, step / 3.0 * v

    x, y, z = (step * s for s in SHIFT)
    return Strained(part, (x, y, z))


@lru_cache(maxsize=32)
def drawn(cameras: str, motion: str, step: int) -> tuple[np.ndarray, np.ndarray]:
    pair = PAIRS[cameras]
    one, two = (
        render(camera, state(motion, step), TEXTURE, size=SIZE, samples=2)  # type: ignore[arg-type]
        for camera in (pair.cam1, pair.cam2)
    )
    return one, two


def take(cameras: str, motion: str, step: int, gain: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([step, *map(ord, cameras + motion)])
    one, two = (digitise(gain * image, noise=2.0, rng=rng) for image in drawn(cameras, motion, step))
    return one, two


class Sequence:
    """A reference and its shape; each step starts from the one before."""

    def __init__(self, cameras: str, motion: str, options: MeasureOptions, gain: float = 1.0) -> None:
        self.of, self.options, self.gain = (cameras, motion), options, gain
        self.reference = ReferencePair(PAIRS[cameras], *take(*self.of, 0, 1.0))
        self.shape = self.reference.shape(GRID, options)

    def step(self, number: int, previous: Field | None) -> Field:
        now = take(*self.of, number, self.gain)
        return self.reference.motion(*now, GRID, self.options, shape=self.shape, previous=previous)

    def steps(self) -> list[Field]:
        fields: list[Field] = []
        for number in (1, 2, 3):
            fields.append(self.step(number, fields[-1] if fields else None))
        return fields


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of points that were measured on warped images, a step each."""
    counts: list[int] = []
    whole = warped.fit_on_warped_images

    def counted(*given, **more):  # type: ignore[no-untyped-def]
        left = whole(*given, **more)
        counts.append(len(given[-1]) - len(left))
        return left

    monkeypatch.setattr("stereorig.core.field.growth.seed.fit_on_warped_images", counted)
    return counts


@pytest.mark.parametrize(
    ("cameras", "gain", "subset_px", "interpolation"),
    [("paper", 1.0, 21, "quintic"), ("paper", 0.8, 15, "cubic"), ("distorted", 1.0, 25, "quintic")],
)
def test_points_on_warped_images_are_those_of_their_own_fits(
    served: list[int], monkeypatch: pytest.MonkeyPatch, cameras: str, gain: float, subset_px: int, interpolation: str
) -> None:
    options = MeasureOptions(subset_px=subset_px, interpolation=interpolation, patch="affine")  # type: ignore[arg-type]
    on_warped = Sequence(cameras, "even", options, gain).steps()
    assert min(served) >= 0.9 * on_warped[0].valid.sum(), served
    monkeypatch.setattr(warped, "LEAST_POINTS", 10**9)
    own = Sequence(cameras, "even", options, gain).steps()
    assert served[2:] == [0, 0]
    start = Strained().material(PAIRS[cameras].cam1, GRID.xy_px)
    for number in (2, 3):
        one, other = on_warped[number - 1], own[number - 1]
        assert one.uvw_mm is not None
        assert other.uvw_mm is not None
        both = one.valid & other.valid
        sigma = np.sqrt(np.diagonal(other.covariance, axis1=2, axis2=3))[..., 3:][both]
        change = (one.uvw_mm - other.uvw_mm)[both] / sigma
        assert (np.sqrt((change**2).mean(axis=0)) < 0.1).all()
        assert np.abs(change).max() < 0.6
        assert (one.status != other.status).mean() <= 1e-3
        ratio = np.sqrt(np.diagonal(one.covariance, axis1=2, axis2=3))[..., 3:][both] / sigma
        assert abs(np.median(ratio) - 1.0) < 0.02  # the field's own scatter corrects it, which differs a little
        assert abs(np.median(one.noise_grey[both] / other.noise_grey[both]) - 1.0) < 0.002
        np.testing.assert_allclose(one.zncc[both], other.zncc[both], atol=2e-4)
        truth = state("even", number).position(start) - Strained().position(start)
        error = (one.uvw_mm - truth)[both] / sigma
        assert (np.abs(np.sqrt((error**2).mean(axis=0)) - 1.0) < 0.1).all()


def test_what_is_kept_of_the_reference_changes_no_digit(served: list[int]) -> None:
    options = MeasureOptions(subset_px=21, patch="affine")
    before = Sequence("paper", "even", options)
    _, second, third = before.steps()
    alone = Sequence("paper", "even", options).step(3, second)
    assert len(served) == 3
    assert min(served) > 1000
    for name in ("uvw_mm", "covariance", "zncc", "noise_grey", "epipolar_px", "status"):
        np.testing.assert_array_equal(getattr(third, name), getattr(alone, name), err_msg=name)


def test_a_step_that_no_smooth_prediction_meets_is_measured_point_by_point(
    served: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = MeasureOptions(subset_px=21, patch="affine")
    fields = Sequence("paper", "kink", options).steps()
    assert served == [0, 0]
    monkeypatch.setattr(warped, "LEAST_POINTS", 10**9)
    for one, other in zip(fields, Sequence("paper", "kink", options).steps(), strict=True):
        np.testing.assert_array_equal(one.uvw_mm, other.uvw_mm)
