"""`CameraSettings` in V4L2's terms: everything is checked before anything is set, then set, then read back."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FeatureValue
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.controls import Control, Controls, Raw
from stereorig.drivers.cameras.v4l2.device import V4l2Device
from stereorig.drivers.cameras.v4l2.formats import GrayFormat, find_format
from stereorig.drivers.cameras.v4l2.picture import FrameLayout, PictureFormat, Rates, Region
from stereorig.drivers.cameras.v4l2.triggers import Triggers

# V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us
_EXPOSURES_PER_MS = 10
# Where a device does not list its rates, one further off than this is not the one requested
_RATE_OFF = 0.01
_MANUAL = (v.EXPOSURE_MANUAL, v.EXPOSURE_SHUTTER_PRIORITY)


@dataclass(frozen=True)
class _Shape:
    """Format, size and region that are to be set."""

    gray: GrayFormat
    width: int
    height: int
    region: Region | None


class Setup:
    """Settings of one device."""

    def __init__(self, device: V4l2Device, picture: PictureFormat, controls: Controls, options: CameraOptions) -> None:
        self.picture = picture
        self.controls = controls
        self.triggers = Triggers(controls, options)
        self._device = device
        self._bounds = picture.bounds()
        self._asked: dict[str, FeatureValue] = {}
        self._armed = False

    def image_size(self) -> tuple[int, int]:
        """Return the whole image: the bounds of a region, or if none can be set, the present format's image."""
        if self._bounds is not None:
            return self._bounds
        layout = self.picture.layout()
        return layout.width, layout.height

    def exposure_range(self) -> tuple[float, float] | None:
        """In ms; ``None`` if the device has no exposure in units of time."""
        control = self._exposure()
        if control is None:
            return None
        return control.lowest / _EXPOSURES_PER_MS, control.highest / _EXPOSURES_PER_MS

    def rate_range(self) -> tuple[float, float] | None:
        """In Hz, at the present format and size."""
        layout = self.picture.layout()
        rates = self.picture.rates(layout.code, layout.width, layout.height) if self.picture.has_rate else None
        return None if rates is None or rates.lowest == rates.highest else (rates.lowest, rates.highest)

    def notes(self) -> dict[str, str]:
        """Further data of the camera for the user."""
        layout = self.picture.layout()
        found = {"image_sizes": self.picture.sizes(layout.code)}
        other = self.picture.other_formats()
        if other:
            found["formats_not_read"] = ", ".join(other)
        gray = layout.gray
        if gray is not None and gray.colour:
            full = layout.quantization == v.QUANTIZATION_FULL_RANGE
            found["brightness"] = "full range" if full else "limited range: black is 16, white is 235 of 255"
        return found

    def _exposure(self) -> Control | None:
        control = self.controls.by_number(v.CID_EXPOSURE_ABSOLUTE)
        return control if control is not None and control.settable else None

    # -- asking ------------------------------------------------------------------------------------------------------

    def apply(self, settings: CameraSettings, *, armed: bool) -> None:
        """Check all of the settings, then set them."""
        self._armed = armed
        shape = self._shape(settings)
        rates = self._checked_rate(settings, shape)
        exposure = self._checked_exposure(settings)
        if settings.gain_db is not None:
            raise self._unknown("gain_db", "V4L2 gives gains no unit; name the control itself (gain) in features")
        triggers = self.triggers.checked(settings.trigger)
        features = [(name, *self.controls.check(name, value)) for name, value in (settings.features or {}).items()]
        layout = self.picture.layout()
        reshaped = not self._has(layout, shape)
        period = self.picture.period() if settings.frame_rate_hz is not None else None
        retimed = settings.frame_rate_hz is not None and (
            period is None or abs(float(1 / period) / settings.frame_rate_hz - 1) > 1e-6
        )
        if armed and (reshaped or retimed):
            raise self._armed_error()

        if reshaped:
            self._reshape(shape)
        if retimed or (reshaped and settings.frame_rate_hz is not None):
            assert settings.frame_rate_hz is not None
            self._put_rate(settings.frame_rate_hz, rates)
        for control, raw in triggers:
            self.controls.put(control, raw)
        for control, raw in exposure:
            # a camera may round an exposure further than its steps: the value taken is read back
            self.controls.put(control, raw, exact=control.number != v.CID_EXPOSURE_ABSOLUTE)
        for name, control, raw in features:
            self.controls.put(control, raw)
            if not control.is_button:
                self._asked[name] = (settings.features or {})[name]
        if settings.trigger is not None:
            self.triggers.settle(settings.trigger)

    def _put_rate(self, rate_hz: float, rates: Rates | None) -> None:
        before = self.picture.period()
        self.picture.set_rate(rate_hz, rates)
        taken = self.picture.period()
        if rates is None and (taken is None or abs(float(1 / taken) / rate_hz - 1) > _RATE_OFF):
            if before is not None:
                self.picture.set_rate(float(1 / before), None)
            now = "no rate that it reports" if taken is None else f"{float(1 / taken):g} Hz"
            raise CameraError(
                f"{self._device.path} was asked for {rate_hz:g} Hz and took {now}.",
                code="setting_not_taken",
                remedy="Ask for the rate that it took, or leave frame_rate_hz out.",
                device=self._device.path,
                setting="frame_rate_hz",
            )

    def make_readable(self) -> None:
        """Leave a format that cannot be read (a webcam's usual JPEG) for the plainest one that can."""
        self._armed = False
        shape = self._shape(CameraSettings())
        if not self._has(self.picture.layout(), shape):
            self._reshape(shape)

    def _shape(self, settings: CameraSettings) -> _Shape:
        layout = self.picture.layout()
        gray = self._checked_format(settings, layout)
        if settings.region_px is None:
            if layout.gray is None:  # the present size belongs to a format that was not requested
                width, height = self._tried_size(gray, layout.width, layout.height, layout)
                return _Shape(gray, width, height, None)
            self._checked_size(gray, layout.width, layout.height, layout)
            return _Shape(gray, layout.width, layout.height, None)
        x0, y0, width, height = settings.region_px
        if self._bounds is None:
            wrong = (x0, y0) != (0, 0) or min(width, height) < 1
            if wrong or self._tried_size(gray, width, height, layout) != (width, height):
                sizes = self.picture.sizes(gray.code) or f"{layout.width} x {layout.height}"
                raise self._out_of_range(
                    "region_px", settings.region_px, f"(0, 0, width, height) with a size of its own: {sizes}"
                )
            return _Shape(gray, width, height, None)
        columns, rows = self._bounds
        if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > columns or y0 + height > rows:
            raise self._out_of_range("region_px", settings.region_px, f"inside {columns} x {rows} px")
        return _Shape(gray, width, height, (x0, y0, width, height))

    def _checked_format(self, settings: CameraSettings, layout: FrameLayout) -> GrayFormat:
        here = self.picture.gray_formats
        if settings.pixel_format is not None:
            gray = find_format(settings.pixel_format, here)
            if gray is None:
                names = ", ".join(one.name.strip() for one in here)
                raise self._out_of_range("pixel_format", settings.pixel_format, names)
            if settings.bit_depth not in (None, gray.bit_depth):
                raise self._out_of_range(
                    "bit_depth", settings.bit_depth, f"{gray.bit_depth} with pixel_format {gray.name.strip()}"
                )
            return gray
        present = layout.gray
        if settings.bit_depth is None:
            return present if present is not None else here[0]
        if present is not None and present.bit_depth == settings.bit_depth:
            return present
        for gray in here:
            if gray.bit_depth == settings.bit_depth:
                return gray
        depths = ", ".join(str(depth) for depth in sorted({one.bit_depth for one in here}))
        raise self._out_of_range("bit_depth", settings.bit_depth, depths)

    def _tried_size(self, gray: GrayFormat, width: int, height: int, layout: FrameLayout) -> tuple[int, int]:
        if (gray.code, width, height) == (layout.code, layout.width, layout.height):
            return width, height
        if self._armed:  # even to try a format is a request that a streaming camera may take amiss
            raise self._armed_error()
        tried = self.picture.tried(gray.code, width, height)
        if tried.code != gray.code:
            raise self._out_of_range("pixel_format", gray.name.strip(), "another one: the device does not take it now")
        return tried.width, tried.height

    def _checked_size(self, gray: GrayFormat, width: int, height: int, layout: FrameLayout) -> None:
        if self._tried_size(gray, width, height, layout) != (width, height):
            raise self._out_of_range(
                "pixel_format",
                gray.name.strip(),
                f"with another image size; give region_px as well ({self.picture.sizes(gray.code)})",
            )

    def _checked_rate(self, settings: CameraSettings, shape: _Shape) -> Rates | None:
        rate_hz = settings.frame_rate_hz
        if rate_hz is None:
            return None
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise self._out_of_range("frame_rate_hz", rate_hz, "positive numbers")
        if not self.picture.has_rate:
            raise self._unknown("frame_rate_hz", "its driver does not let the rate be set; leave it out")
        rates = self.picture.rates(shape.gray.code, shape.width, shape.height)
        if rates is not None and not rates.holds(rate_hz):
            raise self._out_of_range("frame_rate_hz", rate_hz, f"{rates.lowest:g} to {rates.highest:g}")
        return rates

    def _checked_exposure(self, settings: CameraSettings) -> list[tuple[Control, Raw]]:
        wanted = settings.exposure_ms
        if wanted is None:
            return []
        control = self._exposure()
        allowed = self.exposure_range()
        if control is None or allowed is None:
            raise self._unknown(
                "exposure_ms", "it has no exposure in units of time; name its own control (exposure) in features"
            )
        if not allowed[0] <= wanted <= allowed[1]:  # NaN is in no range
            raise self._out_of_range("exposure_ms", wanted, f"{allowed[0]:g} to {allowed[1]:g}")
        step = max(control.step, 1)
        steps = min(
            round((wanted * _EXPOSURES_PER_MS - control.lowest) / step), (control.highest - control.lowest) // step
        )
        found: list[tuple[Control, Raw]] = []
        automatic = self.controls.by_number(v.CID_EXPOSURE_AUTO)
        if automatic is not None and self.controls.get(automatic) not in _MANUAL:
            manual = next((item for item in _MANUAL if item in self.controls.items(automatic)), None)
            if manual is not None:
                found.append((automatic, manual))
        return [*found, (control, control.lowest + max(steps, 0) * step)]

    # -- setting and reading back --------------------------------------------------------------------------------------

    def _has(self, layout: FrameLayout, shape: _Shape) -> bool:
        same = (layout.code, layout.width, layout.height) == (shape.gray.code, shape.width, shape.height)
        return same and (shape.region is None or self.picture.crop() == shape.region)

    def _reshape(self, shape: _Shape) -> None:
        before, crop = self.picture.layout(), self.picture.crop()
        try:
            taken = crop
            if shape.region is not None:
                # the format first: the possible regions may depend on it
                self.picture.set(shape.gray.code, before.width, before.height)
                taken = self.picture.cut(shape.region)
            layout = self.picture.set(shape.gray.code, shape.width, shape.height)
            if shape.region is not None:
                taken = self.picture.crop()  # setting the size may have moved it
            if shape.region is not None and taken != shape.region:
                raise self._out_of_range("region_px", shape.region, f"what it rounds it to: {taken}")
            if (layout.code, layout.width, layout.height) != (shape.gray.code, shape.width, shape.height):
                raise self._out_of_range(
                    "region_px" if shape.region is not None else "pixel_format",
                    shape.region or shape.gray.name.strip(),
                    f"{layout.width} x {layout.height} px of another format, as things are",
                )
            self.picture.require_readable(layout)
        except CameraError:
            if shape.region is not None and crop is not None:
                self.picture.cut(crop)
            self.picture.set(before.code, before.width, before.height)
            raise

    def read(self) -> CameraSettings:
        """Read every setting back from the device; values that it sets by itself are unknown."""
        layout = self.picture.layout()
        period = self.picture.period()
        gray = layout.gray
        return CameraSettings(
            exposure_ms=self._exposure_now(),
            gain_db=None,
            frame_rate_hz=None if period is None else float(1 / period),
            bit_depth=None if gray is None else gray.bit_depth,
            trigger=self.triggers.mode(),
            region_px=self._region_now(layout),
            pixel_format=None if gray is None else gray.name,
            features=self._features_now(),
        )

    def _exposure_now(self) -> float | None:
        control = self._exposure()
        if control is None or control.flags & v.CTRL_FLAG_INACTIVE:
            return None
        raw = self.controls.get(control)
        return None if raw is None else int(raw) / _EXPOSURES_PER_MS

    def _region_now(self, layout: FrameLayout) -> Region | None:
        if self._bounds is None:
            return 0, 0, layout.width, layout.height
        crop = self.picture.crop()
        # a picture of another size than its region is scaled: its pixels are not the sensor's
        return crop if crop is not None and crop[2:] == (layout.width, layout.height) else None

    def _features_now(self) -> dict[str, FeatureValue] | None:
        found: dict[str, FeatureValue] = {}
        for name, like in self._asked.items():
            control = self.controls.find(name)
            value = self.controls.as_asked(control, self.controls.get(control), like)
            if value is not None:
                found[name] = value
        return found or None

    def _armed_error(self) -> CameraError:
        return CameraError(
            f"{self._device.path} cannot change its picture or frame rate while it streams.",
            code="armed",
            remedy="Stop the cameras first.",
            device=self._device.path,
        )

    def _out_of_range(self, name: str, value: object, allowed: str) -> CameraError:
        return self.controls.out_of_range(name, value, allowed)

    def _unknown(self, name: str, why: str) -> CameraError:
        return CameraError(
            f"{self._device.path} cannot set {name}: {why}.",
            code="unknown_feature",
            remedy="Leave it out of the settings, or use the control named above.",
            device=self._device.path,
            setting=name,
        )
