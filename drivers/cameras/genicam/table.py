"""Every feature of one camera with its value and range, for a user who sets one, and for reports of trouble."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.protocol import FeatureValue

_SETTINGS = {
    **dict.fromkeys(synonyms.EXPOSURE, "exposure_ms"),
    **dict.fromkeys(synonyms.RATE, "frame_rate_hz"),
    "Gain": "gain_db",
    "PixelFormat": "pixel_format, bit_depth",
    **dict.fromkeys(("Width", "Height", "OffsetX", "OffsetY"), "region_px"),
    **dict.fromkeys(("TriggerMode", "TriggerSource"), "trigger"),
    "TriggerActivation": "trigger_edge",
}


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One feature as a camera has it now.

    Attributes
    ----------
    name, kind
        As the camera's description has them; ``kind`` is command, enumeration, boolean, float, integer or string.
    access
        ``absent`` if it cannot be used with the present settings of the others.
    value
        Present value; None for a command, and if it cannot be read.
    unit, low, high, step
        Unit, bounds and step of a number; None if the description gives none.
    entries
        Values of an enumeration that can be set now.
    setting
        Key of the rig file by which it is set.
    trouble
        Error of its reading; None if there was none.
    """

    name: str
    kind: str
    access: Literal["read and write", "read only", "locked", "absent"]
    value: FeatureValue | None = None
    unit: str | None = None
    low: float | None = None
    high: float | None = None
    step: float | None = None
    entries: tuple[str, ...] = ()
    setting: str | None = None
    trouble: str | None = None


def feature_table(features: CameraFeatures) -> list[Feature]:
    """Return every feature of a camera, in the order of its description; raises `CameraError` (``camera_lost``)."""
    return [_row(features, name, kind) for name in features.names if (kind := features.kind(name)) is not None]


def _row(features: CameraFeatures, name: str, kind: str) -> Feature:
    found: dict[str, Any] = {"name": name, "kind": kind, "access": "absent", "setting": _SETTINGS.get(name)}
    try:
        if not features.has(name):
            return Feature(**found)
        writable = features.writable(name)
        found["access"] = "read only" if not writable else "locked" if features.locked(name) else "read and write"
        if kind == "command":
            return Feature(**found)
        if kind == "enumeration":
            found["entries"] = features.entries(name)
        if kind in ("integer", "float"):
            bounds = features.bounds(name)
            ends = {"low": bounds.low, "high": bounds.high} if bounds.known else {}
            found |= {**ends, "step": bounds.step, "unit": features.unit(name) or None}
        found["value"] = features.read(name)
    except CameraError as error:
        if error.code == "camera_lost":
            raise
        found["trouble"] = error.cause
    return Feature(**found)
