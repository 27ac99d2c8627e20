"""TARGET.toml and RIG.toml: the command line's description of the grid and of the rig."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, TypedDict

from stereorig.core.boards.board import BOARD_KINDS, DEFAULT_DICTIONARY, BoardKind, BoardTarget, dictionary_id
from stereorig.core.calibration import CalibrationOptions, NominalValues
from stereorig.core.calibration.fit.lens_form import LENS_CHOICES, LensChoice
from stereorig.core.calibration.inputs import MOVES, Moves, least_count_sigma_mm
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.names import CAMERAS
from stereorig.core.target import LINE_GRID, GridTarget

_MAX_BYTES = 1 << 20
_MAX_SIDE_PX = 32_767
DEFAULTS = CalibrationOptions()


@dataclass(frozen=True)
class NominalRig:
    """The part of a rig file that a calibration starts from.

    Attributes
    ----------
    cam1, cam2
        Nominal cameras.
    moves, lens, axis_tilt_sigma_rad, stage_scale_sigma, stage_step_sigma_mm, aspect_sigma
        Of ``[calibration]``, as :class:`stereorig.core.calibration.CalibrationOptions` has them.
    """

    cam1: NominalValues
    cam2: NominalValues
    moves: Moves = DEFAULTS.moves
    lens: LensChoice = DEFAULTS.lens
    axis_tilt_sigma_rad: float = DEFAULTS.axis_tilt_sigma_rad
    stage_scale_sigma: float | None = DEFAULTS.stage_scale_sigma
    stage_step_sigma_mm: float = DEFAULTS.stage_step_sigma_mm
    aspect_sigma: float | None = DEFAULTS.aspect_sigma

    def options(self, held_out_mm: tuple[float, ...], held_out_frames: tuple[int, ...]) -> CalibrationOptions:
        """Return the settings of a calibration with these positions and poses kept for the check."""
        return CalibrationOptions(
            moves=self.moves,
            lens=self.lens,
            held_out_mm=held_out_mm,
            held_out_frames=held_out_frames,
            axis_tilt_sigma_rad=self.axis_tilt_sigma_rad,
            stage_scale_sigma=self.stage_scale_sigma,
            stage_step_sigma_mm=self.stage_step_sigma_mm,
            aspect_sigma=self.aspect_sigma,
        )


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
        return toml_of(path.read_bytes(), path, kind=kind)
    except FileNotFoundError as error:
        raise FileFormatError(
            f"The {kind} {path} does not exist.", code="file_missing", remedy="Check the path."
        ) from error
    except OSError as error:
        raise _malformed(path, kind, error.strerror or str(error)) from error


def toml_of(data: bytes, where: Path | str, *, kind: str) -> dict[str, object]:
    """Return the content of a TOML file; ``where`` names it in messages.

    Raises
    ------
    FileFormatError
        ``toml_malformed``.
    """
    try:
        return tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _malformed(where, kind, f"it is no valid TOML ({error})") from error


def read_target(path: Path) -> GridTarget | BoardTarget:
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
    return target_of(table, where)


def target_of(table: Mapping[str, Any], where: str) -> GridTarget | BoardTarget:
    """Build the target that a table describes; ``where`` names the table in messages.

    Raises
    ------
    FileFormatError
        ``field_invalid`` naming the field.
    """
    kind = table.get("kind", LINE_GRID)
    if kind not in (LINE_GRID, *BOARD_KINDS):
        raise _field(where, "kind", f"is {kind!r}, not one of {', '.join((LINE_GRID, *BOARD_KINDS))}")
    common = _Common(
        pitch_mm=_number(table, "pitch_mm", where, positive=True),
        node_tolerance_mm=_number(table, "node_tolerance_mm", where, default=0.0),
        pitch_scale_sigma=_prior(table, "pitch_scale_sigma", where),
        flatness_mm=_optional(table, "flatness_mm", where),
    )
    try:
        return _grid(table, where, common) if kind == LINE_GRID else _board(kind, table, where, common)
    except FileFormatError:
        raise
    except InputError as error:
        raise FileFormatError(f"{where}: {error.cause}", code="field_invalid", remedy=error.remedy) from error


class _Common(TypedDict):
    pitch_mm: float
    node_tolerance_mm: float
    pitch_scale_sigma: float | None
    flatness_mm: float | None


def _grid(table: Mapping[str, object], where: str, common: _Common) -> GridTarget:
    width = _number(table, "line_width_mm", where, positive=True)
    dark = table.get("dark_lines", True)
    if not isinstance(dark, bool):
        raise _field(where, "dark_lines", f"is {dark!r}, neither true nor false")
    lines = _two(table, "lines", where, "[11, 11]")
    missing = table.get("missing_lines", [[], []])
    if not (isinstance(missing, list) and len(missing) == 2 and all(_whole_numbers(own) for own in missing)):
        raise _field(where, "missing_lines", f"is {missing!r}, not two lists of whole numbers such as [[4], []]")
    return GridTarget(
        lines=lines,
        line_width_mm=width,
        dark_lines=dark,
        missing_lines=(tuple(missing[0]), tuple(missing[1])),
        **common,
    )


def _whole_numbers(value: object) -> bool:
    return isinstance(value, list) and all(type(n) is int for n in value)


def _board(kind: BoardKind, table: Mapping[str, object], where: str, common: _Common) -> BoardTarget:
    dictionary = table.get("dictionary", DEFAULT_DICTIONARY)
    if not isinstance(dictionary, str):
        raise _field(where, "dictionary", f"is {dictionary!r}, not the name of a dictionary")
    if kind == "charuco":
        _number(table, "marker_mm", where, positive=True)
        dictionary_id(dictionary)
    return BoardTarget(
        kind=kind,
        size=_two(table, "size", where, "[9, 6]"),
        marker_mm=_optional(table, "marker_mm", where),
        dictionary=dictionary,
        dot_diameter_mm=_optional(table, "dot_diameter_mm", where),
        **common,
    )


def _two(table: Mapping[str, object], key: str, where: str, example: str) -> tuple[int, int]:
    value = table.get(key)
    if value is None:
        raise _field(where, key, "is missing")
    if not (isinstance(value, list) and len(value) == 2 and all(type(n) is int for n in value)):
        raise _field(where, key, f"is {value!r}, not two whole numbers such as {example}")
    return value[0], value[1]


def read_rig(path: Path) -> NominalRig:
    """Read ``[cam1]``, ``[cam2]`` and ``[calibration]`` of RIG.toml; other tables and keys are left alone.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``toml_malformed``, or ``field_invalid`` naming the field.
    """
    content = load_toml(path, kind="rig description")
    where = f"{path}, [calibration]"
    plan = content.get("calibration", {})
    if not isinstance(plan, Mapping):
        plan = {}
    moves, lens = plan.get("moves", "cameras"), plan.get("lens", "auto")
    for key, value, known in (("moves", moves, MOVES), ("lens", lens, LENS_CHOICES)):
        if value not in known:
            raise _field(where, key, f"is {value!r}, not one of {', '.join(known)}")
    cameras = []
    for name in CAMERAS:
        table = content.get(name)
        if not isinstance(table, Mapping):
            raise _field(str(path), f"[{name}]", "is missing" if table is None else "is not a table")
        cameras.append(_camera(table, f"{path}, [{name}]", free=moves == "free"))
    return NominalRig(
        cam1=cameras[0],
        cam2=cameras[1],
        moves=moves,
        lens=lens,
        axis_tilt_sigma_rad=_number(plan, "axis_tilt_sigma_rad", where, default=DEFAULTS.axis_tilt_sigma_rad),
        stage_scale_sigma=_prior(plan, "stage_scale_sigma", where),
        stage_step_sigma_mm=_number(plan, "stage_step_sigma_mm", where, default=_least_count_sigma(content, path)),
        aspect_sigma=_prior(plan, "aspect_sigma", where),
    )


def _least_count_sigma(content: Mapping[str, object], path: Path) -> float:
    """Return the standard deviation of a position that a stage reads back to its stated resolution; 0 without one."""
    stage = content.get("stage")
    if not isinstance(stage, Mapping):
        return DEFAULTS.stage_step_sigma_mm
    return least_count_sigma_mm(_optional(stage, "resolution_mm", f"{path}, [stage]"))


def _camera(table: Mapping[str, object], where: str, *, free: bool) -> NominalValues:
    size = table.get("image_size_px")
    if size is None:
        raise _field(where, "image_size_px", "is missing")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and 0 < n <= _MAX_SIDE_PX for n in size)):
        raise _field(where, "image_size_px", f"is {size!r}, not [width, height]")
    angle = None if free and "angle_deg" not in table else _number(table, "angle_deg", where)
    if angle is not None and abs(angle) >= 90.0:
        raise _field(where, "angle_deg", f"is {angle:g}, not between -90 and 90")
    # stage positions need all of them; free poses show the aspect ratio too
    standoff = _optional(table, "standoff_mm", where) if free else _number(table, "standoff_mm", where, positive=True)
    aspect = _optional(table, "aspect", where) if free else _number(table, "aspect", where, positive=True)
    return NominalValues(
        image_size_px=(size[0], size[1]),
        phd_px=_number(table, "phd_px", where, positive=True),
        standoff_mm=standoff,
        angle_deg=angle,
        aspect=1.0 if aspect is None else aspect,
    )


def _optional(table: Mapping[str, object], key: str, where: str) -> float | None:
    return None if table.get(key) is None else _number(table, key, where, positive=key != "flatness_mm")


def _prior(table: Mapping[str, object], key: str, where: str) -> float | None:
    """Return a standard deviation, None if it is not stated; 0 states that there is no uncertainty."""
    return None if table.get(key) is None else _number(table, key, where, default=0.0)


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


def _malformed(path: Path | str, kind: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"The {kind} {path} cannot be read: {why}.", code="toml_malformed", remedy="Correct the file named above."
    )


def _field(where: str, field: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"{where}: {field} {why}.", code="field_invalid", remedy="Correct the field named above.", field=field
    )
