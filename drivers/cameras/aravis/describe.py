"""Identity and abilities of a camera, and its IEEE 1588 clock."""

from __future__ import annotations

from core.errors import CameraError
from drivers.cameras.aravis.device import Device
from drivers.cameras.aravis.features import Features
from drivers.cameras.aravis.settings import CameraControl
from drivers.cameras.aravis.stream import RETENTION_S
from drivers.cameras.protocol import CameraDescription

# names of SFNC 2 and, older, of GigE Vision's own features
PTP_ENABLE = ("PtpEnable", "GevIEEE1588")
_PTP_STATUS = ("PtpStatus", "GevIEEE1588Status")
_PTP_LATCH = "PtpDataSetLatch"  # latches the values below
_PTP_MASTER_ID = ("PtpGrandmasterClockID", "PtpParentClockID", "GevIEEE1588ParentClockId")
_PTP_OWN_ID = ("PtpClockID", "GevIEEE1588ClockId")
_FIRMWARE = ("DeviceFirmwareVersion", "DeviceVersion")


def describe(device: Device, features: Features, control: CameraControl) -> CameraDescription:
    """Read everything in `CameraDescription` from the camera."""
    formats = control.formats()
    firmware = features.first(*_FIRMWARE)
    return CameraDescription(
        model=device.text_of("get_model_name"),
        serial=device.text_of("get_device_serial_number"),
        image_size_px=control.full_size_px(),
        bit_depths=tuple(dict.fromkeys(known.bit_depth for known in formats)),
        trigger_modes=control.trigger_modes(),
        exposure_range_ms=control.exposure_range_ms(),
        gain_range_db=control.gain_range_db(),
        frame_rate_range_hz=control.frame_rate_range_hz(),
        driver="aravis",
        firmware="" if firmware is None else str(features.read(firmware)),
        latency_s=RETENTION_S if device.is_gige else 0.0,
        clock=ptp_clock(features),
        counter_range=_counter_range(device, features),
        pixel_formats=tuple(known.name for known in formats),
        feature_names=features.names,
        extra=_extra(device, features),
    )


def _extra(device: Device, features: Features) -> dict[str, str]:
    extra = {"vendor": device.text_of("get_vendor_name"), "protocol": device.protocol}
    if device.is_gige:
        extra["address"] = device.address()
        extra["packet_size_bytes"] = str(device.ask_camera("gv_get_packet_size"))
    status = features.first(*_PTP_STATUS)
    if status is not None:
        extra["ptp_status"] = str(features.read(status))
    return {name: value for name, value in extra.items() if value}


def _counter_range(device: Device, features: Features) -> tuple[int, int]:
    if not device.is_gige:
        return 0, 2**64 - 1
    # block numbers of 16 bit leave zero out; the camera must be set to use the 64 bit ones
    extended = features.first("GevGVSPExtendedIDMode")
    wide = extended is not None and features.read(extended) == "On"
    return 1, 2**64 - 1 if wide else 2**16 - 1


def switch_ptp_on(device: Device, features: Features) -> None:
    """Switch the camera's IEEE 1588 clock on.

    Raises
    ------
    CameraError
        ``ptp_unsupported`` when it has none, or does not switch it on.
    """
    name = next((name for name in PTP_ENABLE if features.kind(name) == "boolean" and features.writable(name)), None)
    if name is not None:
        features.write(name, True)
        if features.read(name) is True:
            return
    raise CameraError(
        f"{device.name} has no IEEE 1588 clock that can be switched on (no {' or '.join(PTP_ENABLE)}).",
        code="ptp_unsupported",
        remedy="Remove ptp from the rig file; without it a pair's skew is measured by the frames' arrival.",
        camera=device.name,
    )


def ptp_clock(features: Features) -> str:
    """Name of the clock that rules the camera's, or an empty string.

    Only where IEEE 1588 is on and the camera reports that it follows a master or is one, and which: two cameras' times
    may be compared when both name the same.
    """
    enable, status = features.first(*PTP_ENABLE), features.first(*_PTP_STATUS)
    if enable is None or status is None or features.read(enable) is not True:
        return ""
    state = str(features.read(status)).lower()
    if state not in ("slave", "master"):
        return ""
    if features.kind(_PTP_LATCH) == "command" and features.writable(_PTP_LATCH):
        features.write(_PTP_LATCH, True)
    # a master follows itself
    name = features.first(*(_PTP_MASTER_ID if state == "slave" else _PTP_OWN_ID))
    if name is None:
        return ""
    number = features.read(name)
    return "ptp:" + (f"{number & 2**64 - 1:016x}" if isinstance(number, int) else str(number))
