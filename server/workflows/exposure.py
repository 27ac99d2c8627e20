"""Search for the exposure at which a picture's brightest parts reach a set level, without saturation.

Grey levels grow with the exposure, but not always in proportion (black level, stray light, gamma), so the search keeps
a bracket: an exposure that is too short and one that is too long.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import CameraError, InputError, StateError
from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.server.workflows.service import Service

#: of full scale: noise of five standard deviations stays below saturation, and most of the range is used
LEVEL = 0.8
LEVEL_LOW, LEVEL_HIGH = 0.2, 0.95
#: share of the brightest pixels that are left out of the level: reflections, hot pixels
_SPECKS_SHARE = 0.001
_TOLERANCE = 0.03  # of the level; a camera's own steps of its exposure are finer
_TRIES = 16
_LARGEST_STEP = 8.0
_NARROW = 1.01
_UNSTEADY = 0.1
_OF_A_PERIOD = 0.9  # a free-running camera needs the rest for its read-out


@dataclass(frozen=True)
class Brightness:
    """Brightness of one picture: level of its brightest parts, over full scale, and share of saturated pixels."""

    level: float
    saturated_share: float

    @property
    def clipped(self) -> bool:
        """True if more than specks are saturated: how far the light goes beyond full scale is not known."""
        return self.saturated_share > _SPECKS_SHARE


@dataclass(frozen=True)
class FoundExposure:
    """An exposure that was searched for, as read back, and the picture's brightness with it."""

    exposure_ms: float
    brightness: Brightness
    pictures: int


def set_exposure(
    service: Service, cam: CameraName, level: float, shortest_ms: float | None = None, longest_ms: float | None = None
) -> tuple[CameraSettings, FoundExposure]:
    """Search and set a camera's exposure; with the hold. Returns its settings as read back, and the found exposure.

    If none is found, the former exposure is set again.

    Raises
    ------
    InputError
        ``exposure_not_settable`` of a camera without an exposure time, ``out_of_range`` of limits that leave none.
    StateError
        As :func:`search_exposure`.
    CameraError
        The camera's own errors.
    """
    unit = service.rig.pair.units[cam]
    had, known = unit.settings.exposure_ms, unit.description.exposure_range_ms
    if had is None or known is None:
        raise InputError(
            f"{cam} states no range of its exposure time, so none can be searched for.",
            code="exposure_not_settable",
            remedy="Set its own control by `features`, or the exposure on the camera.",
            camera=cam,
        )
    low, high = known
    # a longer one would slow the pairs down, and a camera whose frames stay out counts as lost
    if unit.trigger in ("free", "hardware") and unit.rate_hz is not None:
        high = min(high, _OF_A_PERIOD * 1000.0 / unit.rate_hz)
    low, high = max(low, shortest_ms or low), min(high, longest_ms or high)
    if low > high:
        raise InputError(
            f"{cam} can be exposed for {known[0]:g} to {min(known[1], high):.4g} ms; nothing of it is within the "
            "limits given.",
            code="out_of_range",
            remedy="Give other limits.",
            camera=cam,
        )

    def picture(exposure_ms: float) -> tuple[float, Brightness]:
        taken = service.rig.configure(cam, CameraSettings(exposure_ms=exposure_ms))
        captured = service.hardware.call(lambda: service.rig.pair.capture(1))
        return taken.exposure_ms or exposure_ms, brightness(captured.pixels[cam], captured.bit_depth[cam])

    try:
        found = search_exposure(cam, picture, had, (low, high), level)
    except (CameraError, StateError):
        with contextlib.suppress(CameraError):  # the first error is the one to raise
            service.rig.configure(cam, CameraSettings(exposure_ms=had))
        raise
    return unit.settings, found


def brightness(pixels: NDArray[Any], bit_depth: int) -> Brightness:
    """Return the brightness of an image (rows, cols)."""
    full = 2**bit_depth - 1
    return Brightness(float(np.quantile(pixels, 1.0 - _SPECKS_SHARE)) / full, float(np.mean(pixels >= full)))


def search_exposure(
    cam: str,
    picture: Callable[[float], tuple[float, Brightness]],
    start_ms: float,
    limits_ms: tuple[float, float],
    level: float = LEVEL,
) -> FoundExposure:
    """Return the exposure that brings a picture's brightest parts to a level.

    Parameters
    ----------
    cam
        Camera that errors name.
    picture
        Sets an exposure, ms, takes a picture; returns the exposure as read back and the picture's brightness.
    start_ms, limits_ms
        First exposure, and the shortest and longest one that may be used.
    level
        Share of full scale.

    Raises
    ------
    StateError
        ``light_too_weak``, ``light_too_strong`` or ``light_unsteady``.
    """
    low, high = limits_ms
    short, long = low, high
    wanted = min(max(start_ms, low), high)
    for tried in range(1, _TRIES + 1):
        exposure_ms, seen = picture(wanted)
        if not seen.clipped and abs(seen.level / level - 1.0) <= _TOLERANCE:
            again_ms, again = picture(wanted)  # one picture may meet the level by chance, under a flickering lamp
            if again.clipped or abs(again.level / level - 1.0) > _UNSTEADY:
                break
            return FoundExposure(again_ms, again, tried + 1)
        if seen.clipped or seen.level > level:
            if wanted <= low:
                raise _too_strong(cam, exposure_ms, seen, level)
            long = wanted
            guess = wanted / _LARGEST_STEP if seen.clipped else wanted * level / seen.level
        else:
            if wanted >= high:
                raise _too_weak(cam, exposure_ms, seen, level)
            short = wanted
            guess = wanted * min(level / max(seen.level, 1e-6), _LARGEST_STEP)
        if long / short < _NARROW:
            # steps of the exposure, or a gamma's jump, leave no better one; else the light changed during the search
            if not seen.clipped and abs(seen.level / level - 1.0) <= _UNSTEADY:
                return FoundExposure(exposure_ms, seen, tried)
            break
        # a limit itself is tried once the guess is beyond it
        inside = short < guess < long or guess <= low == short or guess >= high == long
        wanted = min(max(guess, low), high) if inside else float(np.sqrt(short * long))
    raise StateError(
        f"{cam}: no exposure brings the picture to {100.0 * level:.0f} % of full scale twice: the light changes.",
        code="light_unsteady",
        remedy="Use a steady light (no mains flicker, no daylight), let the scene rest, then search again.",
        camera=cam,
    )


def _too_weak(cam: str, exposure_ms: float, seen: Brightness, level: float) -> StateError:
    return StateError(
        f"{cam}: with the longest exposure, {exposure_ms:.4g} ms, the brightest parts of the picture reach "
        f"{100.0 * seen.level:.2g} % of full scale; {100.0 * level:.0f} % are wanted.",
        code="light_too_weak",
        remedy="Take the cap off the lens, open the aperture, bring more light, or raise the gain.",
        camera=cam,
        exposure_ms=exposure_ms,
        level=seen.level,
    )


def _too_strong(cam: str, exposure_ms: float, seen: Brightness, level: float) -> StateError:
    return StateError(
        f"{cam}: with the shortest exposure, {exposure_ms:.4g} ms, the brightest parts of the picture are still above "
        f"{100.0 * level:.0f} % of full scale ({100.0 * seen.saturated_share:.2g} % of the pixels are saturated).",
        code="light_too_strong",
        remedy="Close the aperture, dim the light, or lower the gain.",
        camera=cam,
        exposure_ms=exposure_ms,
        level=seen.level,
    )
