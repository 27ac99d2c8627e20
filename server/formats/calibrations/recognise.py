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

from stereorig.core.cameras.camera import (
    ELEVEN_PARAMETER_NAMES,
    POSE_NAMES,
    Camera,
    RigidTransform,
    rotation_from_angles,
)
from stereorig.core.cameras.opencv_full import OpenCVFullLens, opencv_lens_of
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.native import parameters_in
from stereorig.server.formats.calibrations.programs.dice_txt import is_dice_txt, parse_dice_txt
from stereorig.server.formats.calibrations.programs.dice_xml import is_dice, parse_dice_xml
from stereorig.server.formats.calibrations.programs.imported_pair import (
    LENGTHS_MM,
    MAX_SIDE_PX,
    invalid,
    unit_mm,
    unreadable,
)
from stereorig.server.formats.calibrations.programs.matchid_caldat import is_caldat, parse_caldat
from stereorig.server.formats.calibrations.programs.named_numbers import is_pyvale, parse_pyvale
from stereorig.server.formats.calibrations.programs.opencv_yaml import is_half, is_opencv, joined, parse_opencv
from stereorig.server.formats.calibrations.programs.vic3d_xml import is_vic3d, parse_vic3d
from stereorig.server.formats.calibrations.record import CalibrationRecord
from stereorig.server.formats.figures.card import card
from stereorig.server.formats.manifest import checked_bytes

#: text for the option of a command
UNIT_HELP = (
    "unit of length of another program's calibration: um, mm, cm, m, in, or a size as '25 mm' if it counts a board's "
    "squares (mm)"
)
_MAX_BYTES = 64 << 20
_MIN_BASELINE = 1e-6  # as a share of the stand-off
_LARGEST = 1e12  # of a parameter in its unit; the squares of larger ones would soon be infinite


@dataclass(frozen=True)
class LoadedCalibration:
    """A pair of cameras and its origin.

    Attributes
    ----------
    pair
        The cameras; the system frame is the target's for a calibration.json, camera 1's own for the imports.
    image_size1_px, image_size2_px
        (width, height) the calibration was made for, None if the file does not state it.
    source
        ``calibration_json``, ``dice_xml``, ``dice_txt``, ``opencv_yaml``, ``matchid_caldat``, ``vic3d_xml`` or
        ``pyvale_txt``.
    sha256
        SHA-256 of the file's bytes.
    details
        The whole content of a calibration.json, empty for other programs' files.
    notes
        Assumptions made in reading another program's file.
    unit
        Unit of length that the user or another program's file states; None: millimetres were assumed.
    """

    pair: StereoPair
    image_size1_px: tuple[int, int] | None
    image_size2_px: tuple[int, int] | None
    source: str
    sha256: str
    details: dict[str, Any]
    notes: tuple[str, ...] = ()
    unit: str | None = None

    @property
    def imported(self) -> bool:
        """True for another program's calibration, whose own error is not known."""
        return self.source != "calibration_json"

    @cached_property
    def record(self) -> CalibrationRecord:
        """Settings of the calibration; empty where the file does not state them."""
        return CalibrationRecord.model_validate(self.details)

    def __repr__(self) -> str:
        return (
            f"<Calibration from {self.source}: baseline {self.pair.baseline_mm:.2f} mm, "
            f"stereo angle {np.degrees(self.pair.stereo_angle_rad):.2f} degrees>"
        )

    def _repr_html_(self) -> str:
        from stereorig.core.calibration.checks.measures import focal_lengths_px  # its package is slow to load

        sizes = (self.image_size1_px, self.image_size2_px)
        shape_mm = self.record.uncertainty.shape_rms_mm
        facts: list[tuple[str, object]] = [
            ("verdict", self.record.verdict.level),
            ("stereo angle", f"{np.degrees(self.pair.stereo_angle_rad):.3f} degrees"),
            ("baseline", f"{self.pair.baseline_mm:.3f} mm"),
            ("uncertainty left in shape", None if shape_mm is None else f"{1e3 * shape_mm:.3g} um rms"),
        ]
        for name, camera, size in zip(CAMERAS, (self.pair.cam1, self.pair.cam2), sizes, strict=True):
            f_u, f_v = focal_lengths_px(camera.lens)
            at = "" if size is None else f", images of {size[0]} x {size[1]} px"
            facts.append((name, f"f = {f_u:.2f}, {f_v:.2f} px, lens {type(camera.lens).__name__}{at}"))
        return card(f"Calibration from {self.source}", [*facts, ("notes", "; ".join(self.notes))])


IMPORTED = "imported"
_MAX_DEPTH = 30  # levels of nesting; our own files have six


def imported_content(data: bytes, *, name: str, unit: str | None = None) -> dict[str, object]:
    """Return the content of a ``calibration.json`` that carries the bytes of any calibration file.

    A calibration of this program is carried over as it is. Another program's text is wrapped whole, so that no digit
    and no lens term is lost on the way; :func:`parse_calibration` reads either. The unit of length is stored with it.

    Raises
    ------
    FileFormatError, InputError
        As :func:`load_calibration`.
    """
    loaded = parse_calibration(data, name=name, unit=unit)
    if loaded.details:
        if loaded.imported and unit is not None:
            loaded.details[IMPORTED]["unit"] = unit
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
    stated = {} if unit is None else {"unit": unit}
    return {
        IMPORTED: {"kind": loaded.source, "sha256": loaded.sha256, "text": text, **stated},
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
    terms = [key for key in OpenCVFullLens.parameter_names if key in content] if opencv else []
    for key in dict.fromkeys([*needed, *terms]):
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise unreadable(name, f"{key} of {which} is {str(value)[:40]!r}, not a number")
        if not abs(value) < _LARGEST:  # NaN too
            raise invalid(name, f"{key} of {which} is {str(value)[:40]}")
        values[key] = float(value)
    for key in ("fx_px", "fy_px", "z0_mm") if opencv else ("phd_px", "aspect", "z0_mm"):
        if values[key] <= 0.0:
            raise invalid(name, f"{key} of {which} is {values[key]:g}, not positive")
    if not opencv:
        return Camera.from_paper(**values)
    alpha, beta, gamma, *shift = (values.pop(key) for key in POSE_NAMES)
    pose = RigidTransform(rotation_from_angles(alpha, beta, gamma), np.array(shift))
    return Camera(opencv_lens_of(values), pose)


def _size(content: Mapping[str, object], which: str) -> tuple[int, int] | None:
    sizes = content.get("image_size_px", content[which])  # our own files have one entry for both cameras
    size = sizes.get(which, sizes.get("image_size_px")) if isinstance(sizes, dict) else None
    if isinstance(size, list) and len(size) == 2 and all(type(v) is int and 0 < v < MAX_SIDE_PX for v in size):
        return size[0], size[1]
    return None


def _wraps_another(data: bytes) -> bool:
    # the wrapped text would be taken for the file itself: our own layout is checked for first
    return data.lstrip()[:1] == b"{" and f'"{IMPORTED}"'.encode() in data


def _unwrapped(data: bytes, digest: str, name: str, unit: str | None) -> LoadedCalibration:
    content = _document(data, name, "it is damaged JSON")
    part = content.get(IMPORTED)
    text = part.get("text") if isinstance(part, dict) else None
    known = text.encode("utf-8", "replace") if isinstance(text, str) else b""
    if _wraps_another(known) or not _of_another(known):
        raise unreadable(name, "the imported text in it is no calibration")
    kept = part.get("unit") if isinstance(part, dict) else None
    if kept is not None and not isinstance(kept, str):
        raise unreadable(name, "the unit of the imported text in it is no text")
    if kept is not None and unit is not None and unit_mm(kept) != unit_mm(unit):
        raise _other_unit(name, kept, unit)
    return replace(parse_calibration(known, name=name, unit=kept or unit), sha256=digest, details=content)


def _other_unit(name: str, kept: str, unit: str) -> InputError:
    return InputError(
        f"{name} states its lengths in {kept}, but {unit} was given.",
        code="calibration_unit_conflict",
        remedy="Leave the unit out, or import the other program's own file again.",
    )


def _document(data: bytes, name: str, why: str) -> dict[str, Any]:
    """Return a JSON object that can be written again."""
    try:
        content = json.loads(data)
        if b"\\u" in data:
            json.dumps(content, ensure_ascii=False).encode()  # half a character has no form outside JSON
    except (ValueError, RecursionError) as error:
        raise unreadable(name, why) from error
    if not isinstance(content, dict):
        raise unreadable(name, "it is JSON, but has no cam1 and cam2")
    return content


def _of_another(data: bytes) -> bool:
    return any(recognises(data) for recognises in (is_dice, is_opencv, is_caldat, is_vic3d, is_pyvale, is_dice_txt))


def parse_calibration(data: bytes, *, name: str, unit: str | None = None) -> LoadedCalibration:
    """Recognise and read the bytes of a calibration file, see :func:`load_calibration`."""
    digest = hashlib.sha256(data).hexdigest()
    if _wraps_another(data):
        return _unwrapped(data, digest, name, unit)
    found = _of_other_program(data, digest, name)
    if found is None:
        if unit is not None and unit_mm(unit) != LENGTHS_MM["mm"]:
            raise _other_unit(name, "mm", unit)
        return _own(data, digest, name)
    if found.unit is not None and unit is not None and unit_mm(found.unit) != unit_mm(unit):
        raise _other_unit(name, found.unit, unit)
    unit = found.unit if unit is None else unit
    if unit is None:
        return found
    cam1, cam2 = (
        Camera(camera.lens, RigidTransform(pose.rotation, unit_mm(unit) * pose.translation_mm))
        for camera, pose in ((camera, camera.cam_from_sys) for camera in (found.pair.cam1, found.pair.cam2))
    )
    return replace(found, pair=StereoPair(cam1, cam2), unit=unit)


def _of_other_program(data: bytes, digest: str, name: str) -> LoadedCalibration | None:
    """Return another program's calibration, its lengths taken for millimetres; None for bytes of no known program."""
    if is_dice(data):
        pair, size1, size2, notes = parse_dice_xml(data, name=name)
        return LoadedCalibration(pair, size1, size2, "dice_xml", digest, {}, notes)
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
    if is_opencv(data):  # last: its names are plain words
        pair, size, stated = parse_opencv(data, name=name)
        return LoadedCalibration(pair, size, size, "opencv_yaml", digest, {}, unit=stated)
    return None


def _own(data: bytes, digest: str, name: str) -> LoadedCalibration:
    """Return a calibration.json."""
    content = _document(data, name, "it is none of the known kinds")
    if not {"cam1", "cam2"} & content.keys():
        raise unreadable(name, "it is JSON, but has no cam1 and cam2")
    cam1, cam2 = (_camera(name, which, content.get(which)) for which in CAMERAS)
    pair = StereoPair(cam1, cam2)
    if pair.baseline_mm <= _MIN_BASELINE * content["cam1"]["z0_mm"]:  # equal poses differ by rounding
        raise invalid(name, "both cameras have the same position")
    sizes = [_size(content, which) for which in CAMERAS]
    _check_covariance(content, pair, name)
    return LoadedCalibration(pair, sizes[0], sizes[1], "calibration_json", digest, content)


def _check_covariance(content: Mapping[str, object], pair: StereoPair, name: str) -> None:
    """Refuse an impossible covariance; an unreadable one is refused later, when it is needed."""
    try:
        found = parameters_in(content, name=name, pair=pair)
    except FileFormatError:
        return
    if found is not None:
        found.check()


def load_calibration(path: str | Path, *, unit: str | None = None) -> LoadedCalibration:
    """Read a calibration.json, or another program's: DICe XML or text, OpenCV, MatchID caldat, VIC-3D XML, pyvale text.

    Parameters
    ----------
    path
        The file. OpenCV has two files, ``intrinsics`` and ``extrinsics``: either, with the other in the same folder.
    unit
        Unit of length of another program's file, ``m`` or ``25 mm``; None: millimetres, or as an earlier import states.

    Raises
    ------
    FileFormatError
        ``file_missing``; ``calibration_unreadable`` (unknown kind, damaged, something missing);
        ``calibration_unsupported`` (a lens model that cannot be carried over exactly);
        ``calibration_invalid`` (NaN, no rotation, no baseline).
    CalibrationInputError
        ``covariance_not_positive``, ``covariance_parts_differ``.
    InputError
        ``calibration_unit_unknown``, ``calibration_unit_conflict``.
    """
    return parse_calibration(calibration_bytes(path), name=str(path), unit=unit)


def calibration_bytes(path: str | Path) -> bytes:
    """Return the content of a calibration's file; of both OpenCV files, joined, if the other is in the same folder.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``calibration_unreadable``.
    """
    data = _whole_file(Path(path))
    if is_half(data):
        there, word = Path(path).parent, Path(path).name.lower()
        for one, other in (("intrinsic", "extrinsic"), ("extrinsic", "intrinsic")):
            beside = [p for p in there.iterdir() if one in word and p.name.lower() == word.replace(one, other)]
            if beside and is_half(rest := _whole_file(beside[0])):
                return joined(data, rest)
    return data


def _whole_file(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise unreadable(str(path), f"it has {path.stat().st_size} bytes, far more than a calibration")
        return checked_bytes(path)
    except FileNotFoundError as error:
        raise FileFormatError(
            f"The calibration {path} does not exist.", code="file_missing", remedy="Check the path."
        ) from error
    except OSError as error:
        raise unreadable(str(path), error.strerror or str(error)) from error
