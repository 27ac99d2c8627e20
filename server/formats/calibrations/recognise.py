"""Calibration files of any supported kind: recognised by their content, read, and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from core.cameras.camera import ELEVEN_PARAMETER_NAMES, POSE_NAMES, Camera, RigidTransform, rotation_from_angles
from core.cameras.lens import OpenCVLens
from core.cameras.stereo import StereoPair
from core.errors import FileFormatError
from core.names import CAMERAS
from server.formats.calibrations.native import parameters_in
from server.formats.calibrations.programs.dice_txt import is_dice_txt, parse_dice_txt
from server.formats.calibrations.programs.dice_xml import is_dice, parse_dice_xml
from server.formats.calibrations.programs.imported_pair import invalid, unreadable
from server.formats.calibrations.programs.matchid_caldat import is_caldat, parse_caldat
from server.formats.calibrations.programs.opencv_yaml import is_opencv, parse_opencv
from server.formats.calibrations.programs.pyvale_txt import is_pyvale, parse_pyvale
from server.formats.calibrations.programs.vic3d_xml import is_vic3d, parse_vic3d
from server.formats.calibrations.record import CalibrationRecord

_MAX_BYTES = 64 << 20
_MIN_BASELINE = 1e-6  # of the stand-off


@dataclass(frozen=True)
class LoadedCalibration:
    """A pair of cameras and its origin.

    Attributes
    ----------
    pair
        The cameras; the system frame is the target's for a calibration.json, camera 1's own for the imports.
    image_size1_px, image_size2_px
        (width, height) the calibration was made for, None where the file does not state it.
    source
        ``calibration_json``, ``dice_xml``, ``dice_txt``, ``opencv_yaml``, ``matchid_caldat``, ``vic3d_xml`` or
        ``pyvale_txt``.
    sha256
        Of the file's bytes.
    details
        The whole content of a calibration.json, empty for other programs' files.
    notes
        What was assumed in reading another program's file.
    """

    pair: StereoPair
    image_size1_px: tuple[int, int] | None
    image_size2_px: tuple[int, int] | None
    source: str
    sha256: str
    details: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def imported(self) -> bool:
        """True for another program's calibration, whose own error is not known."""
        return self.source != "calibration_json"

    @cached_property
    def record(self) -> CalibrationRecord:
        """Settings of the calibration; empty where the file does not state them."""
        return CalibrationRecord.model_validate(self.details)


IMPORTED = "imported"
_MAX_DEPTH = 30  # levels of nesting; our own files have six


def imported_content(data: bytes, *, name: str) -> dict[str, object]:
    """Return the content of a ``calibration.json`` that carries the bytes of any calibration file.

    A calibration of this program is carried over as it is. Another program's text is wrapped whole, so that no digit
    and no lens term is lost on the way; :func:`parse_calibration` reads either.

    Raises
    ------
    FileFormatError
        As :func:`load_calibration`.
    """
    loaded = parse_calibration(data, name=name)
    if loaded.details:
        if _nested_deeper(loaded.details, _MAX_DEPTH):
            raise unreadable(name, f"it is nested more than {_MAX_DEPTH} levels deep")
        return loaded.details
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        if loaded.source != "vic3d_xml":
            raise unreadable(name, "it is not UTF-8 text") from error
        text = data.decode("latin-1")  # VIC-3D's names of folders; no number is among them
    sizes = {"cam1": loaded.image_size1_px, "cam2": loaded.image_size2_px}
    return {
        IMPORTED: {"kind": loaded.source, "sha256": loaded.sha256, "text": text},
        "image_size_px": {cam: list(size) for cam, size in sizes.items() if size is not None},
    }


def _nested_deeper(value: Any, limit: int) -> bool:
    layer = [value]
    for _ in range(limit):
        parts = [list(v.values()) if isinstance(v, dict) else v for v in layer if isinstance(v, dict | list)]
        layer = [inner for part in parts for inner in part]
    return bool(layer)


def _camera(name: str, which: str, content: Any) -> Camera:
    if not isinstance(content, dict):
        raise unreadable(name, f"{which} is missing" if content is None else f"{which} is not an object")
    opencv = "fx_px" in content and "phd_px" not in content
    needed = ("fx_px", "fy_px", "cx_px", "cy_px", *POSE_NAMES) if opencv else ELEVEN_PARAMETER_NAMES
    missing = [key for key in needed if key not in content]
    if missing:
        raise unreadable(name, f"{which} lacks {', '.join(missing)}")
    values: dict[str, float] = {}
    terms = [key for key in OpenCVLens.parameter_names if key in content] if opencv else []
    for key in dict.fromkeys([*needed, *terms]):
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise unreadable(name, f"{key} of {which} is {value!r}, not a number")
        if not np.isfinite(value):
            raise invalid(name, f"{key} of {which} is {value}")
        values[key] = float(value)
    for key in ("fx_px", "fy_px", "z0_mm") if opencv else ("phd_px", "aspect", "z0_mm"):
        if values[key] <= 0.0:
            raise invalid(name, f"{key} of {which} is {values[key]:g}, not positive")
    if not opencv:
        return Camera.from_paper(**values)
    alpha, beta, gamma, *shift = (values.pop(key) for key in POSE_NAMES)
    pose = RigidTransform(rotation_from_angles(alpha, beta, gamma), np.array(shift))
    return Camera(OpenCVLens(**values), pose)


def _size(content: Mapping[str, object], which: str) -> tuple[int, int] | None:
    sizes = content.get("image_size_px", content[which])  # our own files keep it beside the cameras
    size = sizes.get(which, sizes.get("image_size_px")) if isinstance(sizes, dict) else None
    if isinstance(size, list) and len(size) == 2 and all(isinstance(v, int) and v > 0 for v in size):
        return size[0], size[1]
    return None


def _wraps_another(data: bytes) -> bool:
    # the wrapped text would be taken for the file itself: our own layout is checked for first
    return data.lstrip()[:1] == b"{" and f'"{IMPORTED}"'.encode() in data


def _unwrapped(data: bytes, digest: str, name: str) -> LoadedCalibration:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise unreadable(name, "it is damaged JSON") from error
    part = content.get(IMPORTED)
    text = part.get("text") if isinstance(part, dict) else None
    known = text.encode("utf-8", "replace") if isinstance(text, str) else b""
    if _wraps_another(known) or not _of_another(known):
        raise unreadable(name, "the imported text in it is no calibration")
    return replace(parse_calibration(known, name=name), sha256=digest, details=content)


def _of_another(data: bytes) -> bool:
    return any(recognises(data) for recognises in (is_dice, is_opencv, is_caldat, is_vic3d, is_pyvale, is_dice_txt))


def parse_calibration(data: bytes, *, name: str) -> LoadedCalibration:
    """Recognise and read the bytes of a calibration file, see :func:`load_calibration`."""
    digest = hashlib.sha256(data).hexdigest()
    if _wraps_another(data):
        return _unwrapped(data, digest, name)
    if is_dice(data):
        pair, size1, size2, notes = parse_dice_xml(data, name=name)
        return LoadedCalibration(pair, size1, size2, "dice_xml", digest, {}, notes)
    if is_opencv(data):
        pair, size = parse_opencv(data, name=name)
        return LoadedCalibration(pair, size, size, "opencv_yaml", digest, {})
    if is_vic3d(data):
        pair, size = parse_vic3d(data, name=name)
        return LoadedCalibration(pair, size, size, "vic3d_xml", digest, {})
    if is_caldat(data):
        return LoadedCalibration(parse_caldat(data, name=name), None, None, "matchid_caldat", digest, {})
    if is_pyvale(data):
        return LoadedCalibration(parse_pyvale(data, name=name), None, None, "pyvale_txt", digest, {})
    if is_dice_txt(data):
        pair, size, notes = parse_dice_txt(data, name=name)
        return LoadedCalibration(pair, size, size, "dice_txt", digest, {}, notes)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise unreadable(name, "it is none of the known kinds") from error
    if not isinstance(content, dict) or not {"cam1", "cam2"} & content.keys():
        raise unreadable(name, "it is JSON, but has no cam1 and cam2")
    cam1, cam2 = (_camera(name, which, content.get(which)) for which in CAMERAS)
    pair = StereoPair(cam1, cam2)
    if pair.baseline_mm <= _MIN_BASELINE * content["cam1"]["z0_mm"]:  # equal poses differ by rounding
        raise invalid(name, "both cameras have the same position")
    sizes = [_size(content, which) for which in CAMERAS]
    _check_covariance(content, pair, name)
    return LoadedCalibration(pair, sizes[0], sizes[1], "calibration_json", digest, content)


def _check_covariance(content: Mapping[str, object], pair: StereoPair, name: str) -> None:
    """Refuse a covariance that none can be; one that cannot be read is refused where it is needed."""
    try:
        found = parameters_in(content, name=name, pair=pair)
    except FileFormatError:
        return
    if found is not None:
        found.check()


def load_calibration(path: str | Path) -> LoadedCalibration:
    """Read a calibration.json, or another program's: DICe XML or text, OpenCV, MatchID caldat, VIC-3D XML, pyvale text.

    Raises
    ------
    FileFormatError
        ``file_missing``; ``calibration_unreadable`` (unknown kind, damaged, something missing);
        ``calibration_unsupported`` (a lens model that cannot be carried over exactly);
        ``calibration_invalid`` (NaN, no rotation, no baseline).
    CalibrationInputError
        ``covariance_not_positive``, ``covariance_parts_differ``.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise unreadable(str(path), f"it has {path.stat().st_size} bytes, far more than a calibration")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FileFormatError(
            f"The calibration {path} does not exist.", code="file_missing", remedy="Check the path."
        ) from error
    except OSError as error:
        raise unreadable(str(path), error.strerror or str(error)) from error
    return parse_calibration(data, name=str(path))
