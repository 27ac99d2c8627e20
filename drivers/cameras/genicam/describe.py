"""Identity and abilities of a camera, and its IEEE 1588 clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.errors import NamedCamera
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.genicam.link import held_back_by
from stereorig.drivers.cameras.genicam.settings import CameraControl
from stereorig.drivers.cameras.genicam.synonyms import TEMPERATURE, TEMPERATURE_PLACES, TEMPERATURE_SELECTOR
from stereorig.drivers.cameras.protocol import CameraDescription, CameraIdentity

#: as a driver names the protocol
GIGE = "GigE Vision"

# An offset that the camera does not report: clocks that follow a master by packets agree within this, in ms
_PTP_ERROR_MS = 0.01
_FIRMWARE = ("DeviceFirmwareVersion", "DeviceVersion")


def describe(
    features: CameraFeatures,
    control: CameraControl,
    identity: CameraIdentity,
    *,
    driver: str,
    latency_s: float,
    extra: Mapping[str, str],
) -> CameraDescription:
    """Read everything in `CameraDescription` from the camera's features.

    Parameters
    ----------
    features, control, identity
        The camera's.
    driver, latency_s
        The driver's name, and how long a frame may take beyond its period.
    extra
        More that the driver knows; ``protocol`` decides how frames are numbered. Empty texts are left out.
    """
    formats = control.formats()
    firmware = features.first(*_FIRMWARE)
    clock = ptp_clock(features)
    more = {**extra, "gain": control.gain_kind(), **_ptp_status(features)}
    if extra.get("protocol") == GIGE:
        more["link_share"] = held_back_by(features)
    if control.rate_limit_off:
        more["frame_rate_limit"] = "switched off: a camera that it holds back ignores triggers"
    return CameraDescription(
        model=identity.model,
        serial=identity.serial,
        image_size_px=control.full_size_px(),
        bit_depths=tuple(dict.fromkeys(known.bit_depth for known in formats)),
        trigger_modes=control.trigger_modes(),
        exposure_range_ms=control.exposure_range_ms(),
        gain_range_db=control.gain_range_db(),
        frame_rate_range_hz=control.frame_rate_range_hz(),
        driver=driver,
        firmware="" if firmware is None else str(features.read(firmware)),
        latency_s=latency_s,
        clock=clock,
        clock_error_ms=_clock_error_ms(features, clock),
        counter_range=_counter_range(features, extra.get("protocol") == GIGE),
        pixel_formats=tuple(known.name for known in formats),
        feature_names=features.names,
        extra={name: value for name, value in more.items() if value},
        temperature_c=temperature_c(features),
    )


def _ptp_status(features: CameraFeatures) -> dict[str, str]:
    status = features.first(*synonyms.PTP_STATUS)
    return {} if status is None else {"ptp_status": str(features.read(status))}


def _counter_range(features: CameraFeatures, gige: bool) -> tuple[int, int]:
    if not gige:
        return 0, 2**64 - 1
    # block numbers of 16 bit leave zero out; the camera must be set to use the 64 bit ones
    extended = features.first("GevGVSPExtendedIDMode")
    wide = extended is not None and features.read(extended) == "On"
    return 1, 2**64 - 1 if wide else 2**16 - 1


def switch_ptp_on(device: NamedCamera, features: CameraFeatures) -> None:
    """Switch the camera's IEEE 1588 clock on.

    Raises
    ------
    CameraError
        ``ptp_unsupported`` when it has none, or does not switch it on.
    """
    switches: list[tuple[str, bool | str]] = [(name, True) for name in synonyms.PTP_ENABLE]
    for name, wanted in (*switches, *_ptp_modes(features)):
        if features.writable(name):
            features.write(name, wanted)
            if features.is_at(name, wanted):
                return
    raise CameraError(
        f"{device.name} has no IEEE 1588 clock that can be switched on "
        f"(no {', '.join(synonyms.PTP_ENABLE)} or {synonyms.PTP_MODE}).",
        code="ptp_unsupported",
        remedy="Remove ptp from the rig file; without it a pair's skew is measured by the frames' arrival.",
        camera=device.name,
    )


def _ptp_modes(features: CameraFeatures) -> list[tuple[str, str]]:
    """Return the modes in which the camera's clock may follow a master, the one that may be master too first."""
    entries = features.entries(synonyms.PTP_MODE) if features.has(synonyms.PTP_MODE) else ()
    return [(synonyms.PTP_MODE, mode) for mode in ("Auto", "Slave") if mode in entries]


def ptp_clock(features: CameraFeatures) -> str:
    """Return the name of the clock that rules the camera's, or an empty string.

    Only if IEEE 1588 is on and the camera reports that it follows a master or is one, and which: two cameras' times may
    be compared if both name the same. A number of zero names none.
    """
    if not _ptp_is_on(features):
        return ""
    latch = next((name for name in synonyms.PTP_LATCH if features.kind(name) == "command"), None)
    if latch is not None and features.writable(latch):
        features.write(latch, True)
    status = features.first(*synonyms.PTP_STATUS)
    state = "" if status is None else str(features.read(status)).lower()
    if state not in ("slave", "master"):
        return ""
    # a master follows itself
    name = features.first(*(synonyms.PTP_MASTER_ID if state == "slave" else synonyms.PTP_OWN_ID))
    number = 0 if name is None else features.read(name)
    if isinstance(number, int):
        return f"ptp:{number & 2**64 - 1:016x}" if number else ""
    return f"ptp:{number}" if str(number).strip("0:- ") else ""


def _ptp_is_on(features: CameraFeatures) -> bool:
    enable = features.first(*synonyms.PTP_ENABLE)
    if enable is not None:
        return features.read(enable) is True
    return features.has(synonyms.PTP_MODE) and not features.is_at(synonyms.PTP_MODE, "Off")


def _clock_error_ms(features: CameraFeatures, clock: str) -> float:
    name = features.first(*synonyms.PTP_OFFSET) if clock else None
    if not clock:
        return 0.0
    return _PTP_ERROR_MS if name is None else max(1e-3, abs(features.read_number(name)) / 1e6)


def with_clock(description: CameraDescription, features: CameraFeatures) -> CameraDescription:
    """Return a description with the clock that rules the camera's now, which is found some seconds after the arming."""
    clock = ptp_clock(features)
    return replace(
        description,
        clock=clock,
        clock_error_ms=_clock_error_ms(features, clock),
        extra={**description.extra, **_ptp_status(features)},
    )


# The temperature that a camera reports, by any name that its description gives it.

_T = TypeVar("_T")
#: zero of kelvin, degrees Celsius
_KELVIN = -273.15
#: a number beyond these is no temperature of a camera at work, but a register that is not filled
_LOW_C, _HIGH_C = -60.0, 150.0


def choose_place(features: CameraFeatures) -> None:
    """Let a camera of several thermometers report the sensor's, or the one nearest to it."""
    selector = features.first(*TEMPERATURE_SELECTOR)
    if selector is None or not features.writable(selector):
        return
    known = features.entries(selector)
    place = next((place for place in TEMPERATURE_PLACES if place in known), None)
    if place is not None and not features.is_at(selector, place):
        _asked(lambda: features.write(selector, place))


def temperature_c(features: CameraFeatures) -> float | None:
    """Return the temperature in degrees Celsius; None if the camera has none, or none that can be one.

    Raises
    ------
    CameraError
        ``camera_lost``.
    """
    name = features.first(*TEMPERATURE)
    if name is None:
        return None
    value = _asked(lambda: features.read_number(name))
    if value is None:
        return None
    value += _KELVIN if features.unit(name).strip().lower() in ("k", "kelvin") else 0.0
    return round(value, 3) if math.isfinite(value) and _LOW_C < value < _HIGH_C else None


def _asked(question: Callable[[], _T]) -> _T | None:
    """Return the answer; None if the camera has none now."""
    try:
        return question()
    except CameraError as error:
        if error.code == "camera_lost":
            raise
        return None
