"""Search for an exposure, against sensors whose response is written down here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from stereorig.core.errors import StateError
from stereorig.server.workflows.exposure import Brightness, brightness, search_exposure

FULL = 255.0


def sensor(
    light: Callable[[float], float], *, step_ms: float = 0.001
) -> tuple[list[float], Callable[[float], tuple[float, Brightness]]]:
    """A camera whose brightest parts come to ``light(exposure)`` of full scale, with exposures in steps."""
    asked: list[float] = []

    def picture(exposure_ms: float) -> tuple[float, Brightness]:
        taken = max(round(exposure_ms / step_ms), 1) * step_ms
        asked.append(taken)
        level = light(taken)
        return taken, Brightness(min(round(level * FULL) / FULL, 1.0), 0.2 if level >= 1.0 else 0.0)

    return asked, picture


@pytest.mark.parametrize(
    ("light", "response"),
    [
        (lambda ms: 0.02 * ms, "proportional"),
        (lambda ms: 0.1 + 0.004 * ms, "on a black level"),
        (lambda ms: (0.002 * ms) ** 0.45, "gamma"),
        (lambda ms: 2.0 * ms, "very bright"),
        (lambda ms: 0.0009 * ms, "dim"),
    ],
    ids=["proportional", "black level", "gamma", "bright", "dim"],
)
@pytest.mark.parametrize("start_ms", [0.01, 10.0, 1000.0])
def test_any_response_that_grows_with_the_exposure_is_brought_to_the_level(
    light: Callable[[float], float], response: str, start_ms: float
) -> None:
    asked, picture = sensor(light)
    found = search_exposure("cam1", picture, start_ms, (0.01, 1000.0), 0.8)
    # three hundredths of the level are the search's own tolerance
    assert light(found.exposure_ms) == pytest.approx(0.8, rel=0.035), response
    assert found.pictures == len(asked) <= 17


def test_too_little_light_is_refused_at_the_longest_exposure() -> None:
    asked, picture = sensor(lambda ms: 1e-5 * ms)
    with pytest.raises(StateError, match=r"reach 1\.2 % of full scale; 80 % are wanted") as caught:
        search_exposure("cam2", picture, 10.0, (0.01, 1000.0), 0.8)
    assert caught.value.code == "light_too_weak"
    assert asked[-1] == 1000.0


def test_light_beyond_the_shortest_exposure_is_refused() -> None:
    _, picture = sensor(lambda ms: 1e4 * ms)
    with pytest.raises(StateError) as caught:
        search_exposure("cam1", picture, 10.0, (0.01, 1000.0), 0.8)
    assert caught.value.code == "light_too_strong"


def test_light_that_flickers_is_told_as_such() -> None:
    rng = np.random.default_rng(3)
    _, picture = sensor(lambda ms: 0.02 * ms * float(rng.uniform(0.3, 3.0)))
    with pytest.raises(StateError) as caught:
        search_exposure("cam1", picture, 10.0, (0.01, 1000.0), 0.8)
    assert caught.value.code == "light_unsteady"


def test_coarse_steps_of_the_exposure_give_the_nearest_that_does_not_saturate() -> None:
    _, picture = sensor(lambda ms: 0.025 * ms, step_ms=2.0)  # 30 and 32 ms: 0.75 and 0.8
    found = search_exposure("cam1", picture, 10.0, (2.0, 1000.0), 0.78)
    assert found.exposure_ms in (30.0, 32.0)


def test_specks_do_not_count_as_the_brightest_parts() -> None:
    pixels = np.full((100, 100), 100, np.uint8)
    pixels[0, :9] = 255  # nine of ten thousand
    seen = brightness(pixels, 8)
    assert seen.level == pytest.approx(100 / 255)
    assert not seen.clipped
