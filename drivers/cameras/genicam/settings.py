"""Camera settings as GenICam features: applied all or none, and read back.

Ranges depend on each other (a longer exposure lowers the highest frame rate), so settings are not checked beforehand
but one by one, each just before it is written; one that is refused waits for the others and is tried again. If one
is refused for good, everything is written back as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.errors import NamedCamera
from stereorig.drivers.cameras.genicam.features import Bounds, CameraFeatures
from stereorig.drivers.cameras.pixels import BY_NAME, FORMATS, PixelFormat
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FeatureValue, TriggerMode

_US_PER_MS = 1000.0
_SOFTWARE_ABSENT = "with the features that are there: its software trigger cannot be used"


class CameraControl:
    """Settings of an opened camera; see `stereorig.drivers.cameras.protocol.CameraSettings`.

    Parameters
    ----------
    device, features
        The camera and its features.
    options
        Names of the trigger's line.
    """

    def __init__(self, device: NamedCamera, features: CameraFeatures, options: CameraOptions) -> None:
        self._device = device
        self._features = features
        self._options = options
        #: True while the frame rate's limit is switched off for the triggers' sake
        self.rate_limit_off = False
        self._asked: list[str] = []  # features that were ever set by name: they are read back with the rest

    # ---- abilities of the camera

    def exposure_range_ms(self) -> tuple[float, float] | None:
        """Return the lowest and highest exposure time; None if the camera's description gives none."""
        name = self._features.first(*synonyms.EXPOSURE)
        return None if name is None else _range(self._features.bounds(name), self._units_per_ms(name))

    def gain_range_db(self) -> tuple[float, float] | None:
        """Return the lowest and highest gain; None if the camera counts it in steps of its own."""
        kind = self.gain_kind()
        if kind not in ("dB", "factor"):
            return None
        ends = _range(self._features.bounds("Gain"))
        return ends if ends is None or kind == "dB" else (_in_db(ends[0]), _in_db(ends[1]))

    def frame_rate_range_hz(self) -> tuple[float, float] | None:
        """Return the lowest and highest frame rate with the present exposure and region."""
        name = self._features.first(*synonyms.RATE)
        return None if name is None else _range(self._features.bounds(name))

    def formats(self) -> tuple[PixelFormat, ...]:
        """Pixel formats of the camera that can be read here, the plainest first."""
        names = self._features.entries("PixelFormat")
        return tuple(known for known in FORMATS if known.name in names)

    def full_size_px(self) -> tuple[int, int]:
        """Width and height of the largest region."""
        size = []
        for axis, offset in (("Width", "OffsetX"), ("Height", "OffsetY")):
            features = self._features
            bounds = features.bounds(axis)
            max_size = bounds.high if bounds.known else features.read_number(axis)
            whole, sensor = features.first(f"{axis}Max"), features.first(f"Sensor{axis}")
            if whole is not None:
                max_size = max(max_size, features.read_number(whole))
            elif sensor is not None and features.has(offset):
                # the limit of the width is the whole less the present offset
                max_size = max(max_size, min(features.read_number(sensor), max_size + features.read_number(offset)))
            size.append(int(max_size))
        return size[0], size[1]

    def trigger_modes(self) -> tuple[TriggerMode, ...]:
        """Ways in which the camera can be made to expose."""
        features = self._features
        modes: list[TriggerMode] = ["free"]
        if features.has("TriggerMode") and features.kind("TriggerSource") is not None:
            sources = features.entries("TriggerSource")
            # the command itself may be there only once the camera waits for it
            if self._software_source() is not None and self.software_command() is not None:
                modes.append("software")
            if any(source not in (*synonyms.SOFTWARE_SOURCE, "Off", "None") for source in sources):
                modes.append("hardware")
            if self._action_source() is not None:
                modes.append("action")
        modes += [mode for mode in self._options.trigger_features if mode not in modes]
        return tuple(modes)

    def gain_kind(self) -> Literal["dB", "factor", "raw", ""]:
        """Return the kind of the camera's gain: decibels, a factor, or steps of its own; empty if it has none."""
        features = self._features
        if not features.has("Gain"):
            return "raw" if features.has("GainRaw") else ""
        unit = features.unit("Gain").strip().lower()
        if unit:
            return "dB" if unit == "db" else "factor" if unit in ("x", "times", "factor") else "raw"
        # a camera that names no unit and cannot have a gain of 0 does not count in decibels
        low = features.bounds("Gain").low
        return "factor" if math.isfinite(low) and low > 0.0 else "dB"

    def software_command(self) -> str | None:
        """Return the name of the command that triggers a frame."""
        names = synonyms.SOFTWARE_TRIGGER
        return next((name for name in names if self._features.kind(name) == "command"), None)

    def _software_source(self) -> str | None:
        entries = self._features.entries("TriggerSource")
        return next((name for name in synonyms.SOFTWARE_SOURCE if name in entries), None)

    def _action_source(self) -> str | None:
        entries = self._features.entries("TriggerSource")
        return next((name for name in entries if synonyms.ACTION_SOURCE.fullmatch(name)), None)

    def _units_per_ms(self, name: str) -> float:
        """Return how many of an exposure time's units are a millisecond; without a unit they are microseconds."""
        return _US_PER_MS / synonyms.US_OF_UNIT.get(self._features.unit(name).strip().lower(), 1.0)

    def run_continuously(self) -> None:
        """Have the camera send frame after frame; one whose mode can only be read sends as it does."""
        name = "AcquisitionMode"
        if self._features.writable(name) and "Continuous" in self._features.entries(name):
            self._features.write(name, "Continuous")

    # ---- reading

    def read(self) -> CameraSettings:
        """Return every setting as the device has it."""
        features = self._features
        exposure = features.first(*synonyms.EXPOSURE)
        name = str(features.read("PixelFormat"))
        known = BY_NAME.get(name)
        return CameraSettings(
            exposure_ms=None if exposure is None else features.read_number(exposure) / self._units_per_ms(exposure),
            gain_db=self._read_gain(),
            frame_rate_hz=self._read_rate(),
            bit_depth=None if known is None else known.bit_depth,
            trigger=self._read_trigger(),
            region_px=self._read_region(),
            pixel_format=name,
            features={name: features.read(name) for name in self._asked} or None,
        )

    def _read_gain(self) -> float | None:
        kind = self.gain_kind()
        if kind not in ("dB", "factor"):
            return None
        value = self._features.read_number("Gain")
        return value if kind == "dB" else _in_db(value)

    def _read_rate(self) -> float | None:
        features = self._features
        name, enable = features.first(*synonyms.RATE), features.first(*synonyms.RATE_ENABLE)
        if enable is not None and features.read(enable) is False:
            name = features.first(*synonyms.RESULTING_RATE)
        return None if name is None else features.read_number(name)

    def _read_region(self) -> tuple[int, int, int, int]:
        def value(name: str) -> int:
            return int(self._features.read_number(name)) if self._features.has(name) else 0

        return value("OffsetX"), value("OffsetY"), value("Width"), value("Height")

    def _read_trigger(self) -> TriggerMode:
        features = self._features
        for mode, names in self._options.trigger_features.items():
            values = {name: value for name, value in names.items() if features.kind(name) != "command"}
            if values and all(features.read(name) == value for name, value in values.items()):
                return mode
        if not features.has("TriggerMode"):
            return "free"
        self._select_frame_start()
        if features.is_at("TriggerMode", "Off") or not features.has("TriggerSource"):
            return "free"
        if synonyms.ACTION_SOURCE.fullmatch(str(features.read("TriggerSource"))):
            return "action"
        software = self._software_source()
        return "software" if software is not None and features.is_at("TriggerSource", software) else "hardware"

    # ---- writing

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set the values that are not ``None``; return every setting as read back. All or none. All or none.

        Raises
        ------
        CameraError
            ``out_of_range``, ``unknown_feature``, ``camera_lost``.
        """
        undo = _Undo(self._features)
        asked = [name for name in settings.features or {} if name not in self._asked]
        try:
            for name, value in (settings.features or {}).items():
                self._set_feature(undo, name, value)
            self._set_all(self._steps(settings, undo))
        except CameraError as error:
            if error.code != "camera_lost":
                undo.roll_back()
            raise
        kinds = self._features.kind
        self._asked += [name for name in asked if kinds(name) != "command"]
        return self.read()

    def _steps(self, settings: CameraSettings, undo: _Undo) -> list[Callable[[], None]]:
        steps: list[Callable[[], None]] = []
        if settings.pixel_format is not None or settings.bit_depth is not None:
            format_name = self._choose_format(settings.pixel_format, settings.bit_depth)
            steps.append(lambda: undo.write("PixelFormat", format_name))
        region, exposure, rate = settings.region_px, settings.exposure_ms, settings.frame_rate_hz
        gain, trigger = settings.gain_db, settings.trigger
        if rate is not None and trigger is None and not self._options.trigger_features:
            trigger = self._read_trigger()  # some cameras accept a rate only while no trigger is on
        if region is not None:
            steps.append(lambda: self._set_region(undo, region))
        if exposure is not None:
            steps.append(lambda: self._set_exposure(undo, exposure))
        if rate is not None:
            steps.append(lambda: self._set_rate(undo, rate))
        if gain is not None:
            steps.append(lambda: self._set_gain(undo, gain))
        if trigger is not None:
            steps.append(lambda: self._set_trigger(undo, trigger))
        return steps

    @staticmethod
    def _set_all(steps: list[Callable[[], None]]) -> None:
        while steps:
            refused: list[Callable[[], None]] = []
            first: CameraError | None = None
            for step in steps:
                try:
                    step()
                except CameraError as error:
                    # another setting may be in the way, or bring the feature about
                    if error.code not in ("out_of_range", "unknown_feature"):
                        raise
                    first = first or error
                    refused.append(step)
            if first is not None and len(refused) == len(steps):
                raise first
            steps = refused

    def _set_feature(self, undo: _Undo, name: str, value: FeatureValue) -> None:
        if name not in self._features.names:
            raise self._device.unknown(name, "is no feature of this camera")
        undo.write(name, self._features.check_value(name, value))

    def _choose_format(self, name: str | None, bit_depth: int | None) -> str:
        known = self.formats()
        names = ", ".join(f"{one.name} ({one.bit_depth} bit)" for one in known)
        if name is not None:
            wanted = [one for one in known if one.name == name and bit_depth in (None, one.bit_depth)]
            if not wanted:
                beside = "" if bit_depth is None else f" with {bit_depth} bit"
                raise self._device.out_of_range("pixel_format", name + beside, names)
        else:
            wanted = [one for one in known if one.bit_depth == bit_depth]
            if not wanted:
                raise self._device.out_of_range("bit_depth", bit_depth, names)
        return wanted[0].name

    def _set_exposure(self, undo: _Undo, exposure_ms: float) -> None:
        for other, wanted in synonyms.BEFORE_EXPOSURE.items():
            self._switch(undo, other, wanted)
        name = self._required("exposure_ms", *synonyms.EXPOSURE)
        undo.write(name, self._checked(name, exposure_ms, "exposure_ms", self._units_per_ms(name)))

    def _set_rate(self, undo: _Undo, rate_hz: float) -> None:
        features = self._features
        if features.first(*synonyms.RATE) is None and features.has("TriggerMode"):
            undo.write("TriggerMode", "Off")  # the trigger is set after the rate
        self._switch(undo, "AcquisitionFrameRateAuto", "Off")
        enable = features.first(*synonyms.RATE_ENABLE)
        if enable is not None and features.writable(enable):
            undo.write(enable, True)
        name = self._required("frame_rate_hz", *synonyms.RATE)
        undo.write(name, self._checked(name, rate_hz, "frame_rate_hz"))

    def _limit_rate(self, undo: _Undo, limited: bool) -> None:
        """Switch the limit of the frame rate on or off: a camera that it holds back ignores triggers in silence."""
        enable = self._features.first(*synonyms.RATE_ENABLE)
        if enable is not None and self._features.writable(enable) and self._rate_limited() is not limited:
            undo.write(enable, limited)
            self.rate_limit_off = not limited

    def _rate_limited(self) -> bool:
        enable = self._features.first(*synonyms.RATE_ENABLE)
        return enable is not None and self._features.read(enable) is True

    def _set_gain(self, undo: _Undo, gain_db: float) -> None:
        kind = self.gain_kind()
        if kind not in ("dB", "factor"):
            raise self._device.unknown("gain_db", f"is not there: {self._gain_in_words()}")
        self._switch(undo, "GainAuto", "Off")
        value = gain_db if kind == "dB" else 10.0 ** (gain_db / 20.0)
        undo.write("Gain", self._checked("Gain", value, "gain_db" if kind == "dB" else "the gain's factor"))

    def _gain_in_words(self) -> str:
        names = [name for name in synonyms.GAIN if self._features.has(name)]
        if not names:
            return "it has no gain that can be set"
        unit = self._features.unit(names[0]) or "steps of its own"
        return f"its gain is not in decibels but in {unit}. Set {' or '.join(names)} as a feature"

    def _checked(self, name: str, value: float, shown: str, scale: float = 1.0) -> FeatureValue:
        """Return the value in the camera's unit, as its feature takes it."""
        value = float(value) * scale
        if self._features.kind(name) == "integer" and math.isfinite(value):
            # a camera that takes whole microseconds has no others: the true value is read back
            value = round(value)
        bounds = self._features.bounds(name)
        for limit in (bounds.low, bounds.high):
            if math.isclose(value, limit, rel_tol=1e-12):  # a limit that went through our unit and back
                value = limit
        return self._features.check_value(name, value, shown, scale)

    def _set_region(self, undo: _Undo, region: tuple[int, int, int, int]) -> None:
        features = self._features
        x0, y0, width, height = region
        columns, rows = self.full_size_px()
        steps = {axis: int(features.bounds(axis).step or 1) for axis in ("Width", "Height")}
        if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > columns or y0 + height > rows:
            raise self._device.out_of_range("region_px", region, f"inside {columns} x {rows} px")
        for axis, offset, begin, size in (("Width", "OffsetX", x0, width), ("Height", "OffsetY", y0, height)):
            low = features.bounds(axis).first
            if size < low or (size - low) % steps[axis]:
                allowed = f"a {axis.lower()} from {low} px in steps of {steps[axis]} px"
                raise self._device.out_of_range("region_px", region, allowed)
            if features.writable(offset):
                bounds = features.bounds(offset)
                step = int(bounds.step or 1)
                if begin < bounds.low or (begin - bounds.first) % step:
                    raise self._device.out_of_range(
                        "region_px", region, f"{offset} from {bounds.first} in steps of {step} px"
                    )
                # with the old offset the new size might not fit
                undo.write(offset, bounds.first)
            elif begin != (features.read(offset) if features.has(offset) else 0):
                raise self._device.out_of_range("region_px", region, f"regions whose {offset} is as it is")
            undo.write(axis, size)
            if features.writable(offset):
                undo.write(offset, begin)

    def _set_trigger(self, undo: _Undo, mode: TriggerMode) -> None:
        features, options = self._features, self._options
        if mode not in self.trigger_modes():
            raise self._device.out_of_range("trigger", mode, ", ".join(self.trigger_modes()))
        by_name: Mapping[str, FeatureValue] | None = options.trigger_features.get(mode)
        if by_name is not None:
            for name, value in by_name.items():
                self._set_feature(undo, name, value)
            return
        if not features.has("TriggerMode"):
            return
        self._switch_others_off(undo)
        self._select_frame_start(undo)
        if mode == "free":
            undo.write("TriggerMode", "Off")
            if self.rate_limit_off:
                self._limit_rate(undo, True)
            return
        source = options.trigger_source
        if mode == "software":
            source = self._software_source() or synonyms.SOFTWARE_SOURCE[0]
        if mode == "action":
            source = self._action_source() or source
            self._set_action(source)
        if not features.has("TriggerSource") or not features.is_at("TriggerSource", source) or self._rate_limited():
            undo.write("TriggerMode", "Off")  # while it is on, some cameras lock the following features
        self._limit_rate(undo, False)
        there = features.has("TriggerSource")
        if there:
            self._set_source(undo, source)
        if mode == "hardware":
            self._set_edge(undo)
        undo.write("TriggerMode", "On")
        if not there:
            self._set_source(undo, source)
        command = self.software_command()
        if mode == "software" and (command is None or not features.has(command)):
            raise self._device.out_of_range("trigger", mode, _SOFTWARE_ABSENT)

    def _set_action(self, source: str) -> None:
        """Set the keys of the commands that the camera obeys; some cameras give no key back, so none is restored."""
        features, keys = self._features, self._options.action_keys
        if keys is None:
            raise self._device.out_of_range("trigger", "action", "with keys: use trigger = 'action' in the rig file")
        if features.kind("ActionSelector") == "integer" and features.writable("ActionSelector"):
            features.write("ActionSelector", int(source.removeprefix("Action")))
        for name, key in zip(synonyms.ACTION_KEYS, keys, strict=True):
            features.write(name, key)

    def _set_source(self, undo: _Undo, source: str) -> None:
        known = self._features.entries("TriggerSource")
        if source not in known:
            raise self._device.out_of_range("trigger_source", source, ", ".join(known))
        undo.write("TriggerSource", source)

    def _switch_others_off(self, undo: _Undo) -> None:
        """Switch all triggers off except the frame's: a camera that waits for a second one would stay silent."""
        features = self._features
        if not features.writable("TriggerSelector"):
            return
        for selector in features.entries("TriggerSelector"):
            if selector != self._frame_start():
                undo.write("TriggerSelector", selector)
                if features.writable("TriggerMode"):
                    undo.write("TriggerMode", "Off")

    def _set_edge(self, undo: _Undo) -> None:
        edge = {"rising": "RisingEdge", "falling": "FallingEdge"}[self._options.trigger_edge]
        entries = self._features.entries("TriggerActivation") if self._features.has("TriggerActivation") else ()
        if edge in entries:
            undo.write("TriggerActivation", edge)
        elif edge != "RisingEdge" or "FallingEdge" in entries:
            known = ", ".join(entries) or "as it is: it has no TriggerActivation"
            raise self._device.out_of_range("trigger_edge", edge, known)

    def _frame_start(self) -> str | None:
        entries = self._features.entries("TriggerSelector")
        return next((name for name in synonyms.FRAME_START if name in entries), entries[0] if entries else None)

    def _select_frame_start(self, undo: _Undo | None = None) -> None:
        features, wanted = self._features, self._frame_start()
        if (
            wanted is not None
            and features.writable("TriggerSelector")
            and not features.is_at("TriggerSelector", wanted)
        ):
            (undo or features).write("TriggerSelector", wanted)

    def _switch(self, undo: _Undo, name: str, wanted: str) -> None:
        """Set an enumeration that would overrule a setting, if the camera has it."""
        features = self._features
        if features.kind(name) == "enumeration" and features.writable(name) and wanted in features.entries(name):
            undo.write(name, wanted)

    def _required(self, setting: str, *names: str) -> str:
        name = self._features.first(*names)
        if name is None:
            raise self._device.unknown(setting, f"is not there: it has no {' or '.join(names)}")
        return name


def _range(bounds: Bounds, scale: float = 1.0) -> tuple[float, float] | None:
    return (bounds.low / scale, bounds.high / scale) if bounds.known else None


def _in_db(factor: float) -> float:
    return 20.0 * math.log10(factor) if factor > 0.0 else -math.inf


class _Undo:
    """Writes features and keeps their former values."""

    def __init__(self, features: CameraFeatures) -> None:
        self._features = features
        self._before: list[tuple[str, FeatureValue]] = []

    def write(self, name: str, value: Any) -> None:
        features = self._features
        if features.kind(name) == "command":
            features.write(name, value)
            return
        before = features.read(name)
        # a value that is right already stays: some devices round differently each time that a value is written
        if not features.is_at(name, value):
            features.write(name, value)
            self._before.append((name, before))
            features.check_taken(name, value)

    def roll_back(self) -> None:
        while self._before:
            name, before = self._before.pop()
            self._features.write(name, before)
