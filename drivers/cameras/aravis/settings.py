"""Camera settings as GenICam features: applied all or none, and read back.

Ranges depend on each other (a longer exposure lowers the highest frame rate), so settings are not checked beforehand
but one by one, each just before it is written; one that is refused waits for the others and is tried again. If one
is refused for good, everything is written back as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from core.errors import CameraError
from drivers.cameras.aravis.device import Device
from drivers.cameras.aravis.features import Features
from drivers.cameras.pixels import BY_NAME, FORMATS, PixelFormat
from drivers.cameras.protocol import CameraOptions, CameraSettings, FeatureValue, TriggerMode

EXPOSURE = ("ExposureTime", "ExposureTimeAbs")  # SFNC 2 and 1; both in microseconds
RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
RATE_ENABLE = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_RESULTING_RATE = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
_BEFORE_EXPOSURE = {"ExposureAuto": "Off", "ExposureMode": "Timed"}
_US_PER_MS = 1000.0


class CameraControl:
    """Settings of an opened camera; see `drivers.cameras.protocol.CameraSettings`.

    Parameters
    ----------
    device, features
        The camera and its features.
    options
        Names of the trigger's line.
    """

    def __init__(self, device: Device, features: Features, options: CameraOptions) -> None:
        self._device = device
        self._features = features
        self._options = options
        self._asked: list[str] = []  # features that were ever set by name: they are read back with the rest

    # ---- what the camera can do

    def exposure_range_ms(self) -> tuple[float, float] | None:
        """Lowest and highest exposure time."""
        name = self._features.first(*EXPOSURE)
        if name is None:
            return None
        bounds = self._features.bounds(name)
        return bounds.low / _US_PER_MS, bounds.high / _US_PER_MS

    def gain_range_db(self) -> tuple[float, float] | None:
        """Lowest and highest gain; None where the camera's gain is in no known unit."""
        if not self._gain_in_db():
            return None
        bounds = self._features.bounds("Gain")
        return bounds.low, bounds.high

    def frame_rate_range_hz(self) -> tuple[float, float] | None:
        """Lowest and highest frame rate with the present exposure and region."""
        name = self._features.first(*RATE)
        if name is None:
            return None
        bounds = self._features.bounds(name)
        return bounds.low, bounds.high

    def formats(self) -> tuple[PixelFormat, ...]:
        """Pixel formats of the camera that can be read here, the plainest first."""
        names = self._features.entries("PixelFormat")
        return tuple(known for known in FORMATS if known.name in names)

    def full_size_px(self) -> tuple[int, int]:
        """Width and height of the largest region."""
        size = []
        for axis, offset in (("Width", "OffsetX"), ("Height", "OffsetY")):
            features = self._features
            max_size = features.bounds(axis).high
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
        if features.has("TriggerMode") and features.has("TriggerSource"):
            sources = features.entries("TriggerSource")
            if "Software" in sources and features.has("TriggerSoftware"):
                modes.append("software")
            if any(source not in ("Software", "Off") for source in sources):
                modes.append("hardware")
        modes += [mode for mode in self._options.trigger_features if mode not in modes]
        return tuple(modes)

    def _gain_in_db(self) -> bool:
        # GainRaw counts steps of the camera's own; Gain is in decibels unless the camera has another unit
        return self._features.has("Gain") and self._features.unit("Gain").strip().lower() in ("", "db")

    # ---- reading

    def read(self) -> CameraSettings:
        """Return every setting as the device has it."""
        features = self._features
        exposure = features.first(*EXPOSURE)
        name = str(features.read("PixelFormat"))
        known = BY_NAME.get(name)
        return CameraSettings(
            exposure_ms=None if exposure is None else features.read_number(exposure) / _US_PER_MS,
            gain_db=features.read_number("Gain") if self._gain_in_db() else None,
            frame_rate_hz=self._read_rate(),
            bit_depth=None if known is None else known.bit_depth,
            trigger=self._read_trigger(),
            region_px=self._read_region(),
            pixel_format=name,
            features={name: features.read(name) for name in self._asked} or None,
        )

    def _read_rate(self) -> float | None:
        features = self._features
        name, enable = features.first(*RATE), features.first(*RATE_ENABLE)
        if enable is not None and features.read(enable) is False:
            name = features.first(*_RESULTING_RATE)
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
        if features.read("TriggerMode") == "Off" or not features.has("TriggerSource"):
            return "free"
        return "software" if features.read("TriggerSource") == "Software" else "hardware"

    # ---- writing

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set what is not ``None``; return every setting as read back. All or none.

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
                    if error.code != "out_of_range":
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
        for other, wanted in _BEFORE_EXPOSURE.items():
            self._switch(undo, other, wanted)
        name = self._required("exposure_ms", *EXPOSURE)
        undo.write(name, self._checked(name, exposure_ms, "exposure_ms", _US_PER_MS))

    def _set_rate(self, undo: _Undo, rate_hz: float) -> None:
        self._switch(undo, "AcquisitionFrameRateAuto", "Off")
        enable = self._features.first(*RATE_ENABLE)
        if enable is not None:
            undo.write(enable, True)
        name = self._required("frame_rate_hz", *RATE)
        undo.write(name, self._checked(name, rate_hz, "frame_rate_hz"))

    def _set_gain(self, undo: _Undo, gain_db: float) -> None:
        if not self._gain_in_db():
            raise self._device.unknown(
                "gain_db", "is not there: its gain is not in decibels. Set Gain or GainRaw as a feature"
            )
        self._switch(undo, "GainAuto", "Off")
        undo.write("Gain", self._checked("Gain", gain_db, "gain_db"))

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
            low = int(features.bounds(axis).low)
            if size < low or (size - low) % steps[axis]:
                allowed = f"a {axis.lower()} from {low} px in steps of {steps[axis]} px"
                raise self._device.out_of_range("region_px", region, allowed)
            if features.writable(offset):
                bounds = features.bounds(offset)
                step = int(bounds.step or 1)
                if begin < bounds.low or (begin - int(bounds.low)) % step:
                    raise self._device.out_of_range(
                        "region_px", region, f"{offset} from {bounds.low} in steps of {step} px"
                    )
                # with the old offset the new size might not fit
                undo.write(offset, int(bounds.low))
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
        for selector in features.entries("TriggerSelector") if features.has("TriggerSelector") else ():
            # a camera that waits for a second kind of trigger would stay silent
            if selector != self._frame_start():
                undo.write("TriggerSelector", selector)
                if features.has("TriggerMode"):
                    undo.write("TriggerMode", "Off")
        self._select_frame_start(undo)
        if mode == "free":
            undo.write("TriggerMode", "Off")
            return
        source = "Software" if mode == "software" else options.trigger_source
        if source not in features.entries("TriggerSource"):
            raise self._device.out_of_range("trigger_source", source, ", ".join(features.entries("TriggerSource")))
        if mode == "hardware":
            self._set_edge(undo)
        undo.write("TriggerSource", source)
        undo.write("TriggerMode", "On")

    def _set_edge(self, undo: _Undo) -> None:
        edge = {"rising": "RisingEdge", "falling": "FallingEdge"}[self._options.trigger_edge]
        if self._features.has("TriggerActivation"):
            undo.write("TriggerActivation", self._features.check_value("TriggerActivation", edge, "trigger_edge"))
        elif edge != "RisingEdge":
            raise self._device.unknown("trigger_edge", "is fixed: it has no TriggerActivation")

    def _frame_start(self) -> str:
        entries = self._features.entries("TriggerSelector")
        return next((name for name in ("FrameStart", "ExposureStart") if name in entries), entries[0])

    def _select_frame_start(self, undo: _Undo | None = None) -> None:
        features = self._features
        if features.has("TriggerSelector") and features.read("TriggerSelector") != self._frame_start():
            (undo or features).write("TriggerSelector", self._frame_start())

    def _switch(self, undo: _Undo, name: str, wanted: str) -> None:
        """Set an enumeration that would overrule a setting, where the camera has it."""
        features = self._features
        if features.kind(name) == "enumeration" and features.writable(name) and wanted in features.entries(name):
            undo.write(name, wanted)

    def _required(self, setting: str, *names: str) -> str:
        name = self._features.first(*names)
        if name is None:
            raise self._device.unknown(setting, f"is not there: it has no {' or '.join(names)}")
        return name


class _Undo:
    """Writes features and keeps their former values."""

    def __init__(self, features: Features) -> None:
        self._features = features
        self._before: list[tuple[str, FeatureValue]] = []

    def write(self, name: str, value: Any) -> None:
        features = self._features
        if features.kind(name) == "command":
            features.write(name, value)
            return
        before = features.read(name)
        # what is right already stays: some devices round differently each time that a value is written
        if before != value:
            features.write(name, value)
            self._before.append((name, before))

    def roll_back(self) -> None:
        while self._before:
            name, before = self._before.pop()
            self._features.write(name, before)
