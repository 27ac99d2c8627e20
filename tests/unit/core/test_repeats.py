"""A texture that repeats itself: what an image keeps of the places that were looked at."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region import textured as module

SUBSET_PX = 21


def checkered(period_px: int) -> np.ndarray:
    """A random tile again and again."""
    tile = np.random.default_rng(3).integers(0, 255, (period_px, period_px), dtype=np.uint8)
    return np.tile(tile, (240 // period_px, 240 // period_px))


def grid(first: float, last: float) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(first, last, 6), np.linspace(first, last, 6))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_places_are_looked_at_once_and_known_by_subset(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[tuple[int, int, int]] = []
    peak = module._second_peak

    def counted(pixels: np.ndarray, subset_px: int, x: int, y: int) -> float:
        looked.append((subset_px, x, y))
        return peak(pixels, subset_px, x, y)

    monkeypatch.setattr(module, "_second_peak", counted)
    # half of it repeats itself every 20 px, half does not within 120
    pixels = np.hstack([checkered(20)[:, :120], checkered(240)[:, :120]])
    image = MeasureImage(pixels)
    xy = np.concatenate([grid(45, 70), grid(180, 200)])
    found = image.repeating(xy, SUBSET_PX)
    assert found[:36].all()
    assert not found[36:].any()
    assert 0 < len(looked) <= 24
    assert len(set(looked)) == len(looked)
    before = len(looked)
    # the same image under another name, in a later step
    assert np.array_equal(MeasureImage(image, "again").repeating(xy, SUBSET_PX), found)
    assert len(looked) == before
    # squares of other subsets are others
    image.repeating(xy, 25)
    assert len(looked) == 2 * before
    # another picture knows nothing of this one
    assert np.array_equal(MeasureImage(pixels.copy()).repeating(xy, SUBSET_PX), found)
    assert len(looked) == 3 * before
