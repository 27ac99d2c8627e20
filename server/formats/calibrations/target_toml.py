"""TARGET.toml and RIG.toml: the command line's description of the grid and of the rig."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from core.calibration import NominalCamera
from core.errors import FileFormatError, InputError
from core.names import CAMERAS
from core.target import GridTarget

_MAX_BYTES = 1 << 20
_MAX_SIDE_PX = 32_767


@dataclass(frozen=True)
class NominalRig:
    """The part of a rig file that a calibration starts from.

    Attributes
    ----------
    cam1, cam2
        Nominal cameras.
    axis_tilt_sigma_rad
        ``axis_tilt_sigma_rad`` of ``[calibration]``, 0 where the file does not declare it.
    """

    cam1: NominalCamera
    cam2: NominalCamera
    axis_tilt_sigma_rad: float = 0.0


def load_toml(path: Path, *, kind: str) -> dict[str, object]:
    """Read a TOML file.

    Raises
    ------
    FileFormatError
        ``file_missing`` or ``toml_malformed``.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise _malformed(path, kind, f"it has {path.stat().st_size} bytes")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileFormatError(
            f"The {kind} {path} does not exist.", code="file_missing", remedy="Check the path."
        ) from error
    except OSError as error:
        raise _malformed(path, kind, error.strerror or str(error)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _malformed(path, kind, f"it is no valid TOML ({error})") from error


def read_target(path: Path) -> GridTarget:
    """Read TARGET.toml: the fields at top level, or in a table ``[target]``.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``toml_malformed``, or ``field_invalid`` naming the field.
    """
    content = load_toml(path, kind="target description")
    table = content.get("target", content)
    where = f"{path}, [target]" if "target" in content else str(path)
    if not isinstance(table, Mapping):
        raise _field(where, "target", "is not a table")
    pitch = _number(table, "pitch_mm", where, positive=True)
    width = _number(table, "line_width_mm", where, positive=True)
    tolerance = _number(table, "node_tolerance_mm", where, default=0.0)
    lines = table.get("lines")
    if lines is None:
        raise _field(where, "lines", "is missing")
    if not (isinstance(lines, list) and len(lines) == 2 and all(type(n) is int for n in lines)):
        raise _field(where, "lines", f"is {lines!r}, not two whole numbers such as [11, 11]")
    dark = table.get("dark_lines", True)
    if not isinstance(dark, bool):
        raise _field(where, "dark_lines", f"is {dark!r}, neither true nor false")
    try:
        return GridTarget(
            pitch_mm=pitch,
            lines=(lines[0], lines[1]),
            line_width_mm=width,
            node_tolerance_mm=tolerance,
            dark_lines=dark,
        )
    except InputError as error:
        raise FileFormatError(f"{where}: {error.cause}", code="field_invalid", remedy=error.remedy) from error


def read_rig(path: Path) -> NominalRig:
    """Read ``[cam1]`` and ``[cam2]`` of RIG.toml; other tables and keys are left alone.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``toml_malformed``, or ``field_invalid`` naming the field.
    """
    content = load_toml(path, kind="rig description")
    cameras = []
    for name in CAMERAS:
        table = content.get(name)
        if not isinstance(table, Mapping):
            raise _field(str(path), f"[{name}]", "is missing" if table is None else "is not a table")
        cameras.append(_camera(table, f"{path}, [{name}]"))
    plan = content.get("calibration", {})
    tilt = 0.0
    if isinstance(plan, Mapping):
        tilt = _number(plan, "axis_tilt_sigma_rad", f"{path}, [calibration]", default=0.0)
    return NominalRig(cameras[0], cameras[1], tilt)


def _camera(table: Mapping[str, object], where: str) -> NominalCamera:
    size = table.get("image_size_px")
    if size is None:
        raise _field(where, "image_size_px", "is missing")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and 0 < n <= _MAX_SIDE_PX for n in size)):
        raise _field(where, "image_size_px", f"is {size!r}, not [width, height]")
    angle = _number(table, "angle_deg", where)
    if abs(angle) >= 90.0:
        raise _field(where, "angle_deg", f"is {angle:g}, not between -90 and 90")
    return NominalCamera(
        image_size_px=(size[0], size[1]),
        phd_px=_number(table, "phd_px", where, positive=True),
        standoff_mm=_number(table, "standoff_mm", where, positive=True),
        angle_deg=angle,
        aspect=_number(table, "aspect", where, positive=True),
    )


def _number(
    table: Mapping[str, object], key: str, where: str, *, positive: bool = False, default: float | None = None
) -> float:
    value = table.get(key, default)
    if value is None:
        raise _field(where, key, "is missing")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _field(where, key, f"is {value!r}, not a number")
    if not isfinite(value):
        raise _field(where, key, f"is {value}, not a finite number")
    if positive and not value > 0.0:
        raise _field(where, key, f"is {value:g}, not positive")
    if default is not None and value < 0.0:
        raise _field(where, key, f"is {value:g}, negative")
    return float(value)


def _malformed(path: Path, kind: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"The {kind} {path} cannot be read: {why}.", code="toml_malformed", remedy="Correct the file named above."
    )


def _field(where: str, field: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"{where}: {field} {why}.", code="field_invalid", remedy="Correct the field named above.", field=field
    )
