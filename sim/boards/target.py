"""The calibration target of a simulated rig: its nominal description, and the maker's errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from stereorig.core.arrays import Float
from stereorig.sim.boards.dots import dots_board
from stereorig.sim.boards.pattern import field_points
from stereorig.sim.boards.squares import charuco_squares, checkerboard_squares, squares_board
from stereorig.sim.surface import Surface, bowl, flat
from stereorig.sim.texture import Texture, line_grid

TARGET_KINDS: Final = ("line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric")
_CHROME, _BACKLIT = 0.03, 0.9
_MOST, _LEAST, _MOST_LINES = 200, 3, 501
_LEAST_PITCH_MM, _MOST_PITCH_MM, _MOST_PITCH_ERROR = 1e-3, 1e4, 0.1


@dataclass(frozen=True, kw_only=True)
class SimTarget:
    """The calibration target: the rig file's ``[target]``; its faults from ``[sim.target]`` or a scene's parameters.

    Attributes
    ----------
    kind
        One of :data:`TARGET_KINDS`.
    pitch_mm, lines, line_width_mm, dark_lines
        The line grid's, see :func:`stereorig.sim.texture.line_grid`.
    size, marker_mm, dictionary
        A board's: (columns, rows) of inner corners or dots, side and dictionary of ChArUco's markers.
    node_tolerance_mm
        The maker's errors are uniform within it, each axis.
    pitch_error
        Relative error of the pitch: the whole print is larger by it.
    bow_mm
        Rise of the bent board at half the longer side of its field of points, positive away from the viewer.
    dot_mm, margin_mm, edge_mm
        Diameter of a dot (half the pitch if None), white margin (one pitch if None), softness of the edges (see
        `stereorig.sim.boards.squares` if None).
    marks
        Three dots of a symmetric grid are rings.
    """

    pitch_mm: float
    kind: str = "line_grid"
    lines: tuple[int, int] = (0, 0)
    line_width_mm: float = 0.0
    node_tolerance_mm: float = 0.0
    dark_lines: bool = True
    size: tuple[int, int] = (0, 0)
    marker_mm: float = 0.0
    dictionary: str = "DICT_5X5_100"
    pitch_error: float = 0.0
    bow_mm: float = 0.0
    dot_mm: float | None = None
    margin_mm: float | None = None
    edge_mm: float | None = None
    marks: bool = False

    @property
    def background(self) -> float | None:
        """Brightness about a line grid, whose glass fills the view; None for boards, whose texture has it."""
        return (_BACKLIT if self.dark_lines else _CHROME) if self.kind == "line_grid" else None

    @property
    def true_pitch_mm(self) -> float:
        """Pitch as it was made."""
        return self.pitch_mm * (1.0 + self.pitch_error)

    def nominal_points_mm(self) -> Float:
        """Positions (rows, columns, 2) of intersections, corners or dots on a target without faults."""
        return field_points(self.kind, self.lines if self.kind == "line_grid" else self.size, self.pitch_mm)

    def half_field_mm(self) -> tuple[float, float]:
        """Half the extent of the field of points along X and Y."""
        x, y = np.abs(self.nominal_points_mm()).max(axis=(0, 1))
        return float(x), float(y)

    def points_mm(self, seed: int) -> Float:
        """True positions (rows, columns, 3) in the target's frame: X along a row, Y down, Z away from the viewer."""
        xy = self.nominal_points_mm() * (1.0 + self.pitch_error) + self.errors_mm(seed)
        return self.surface().positions(xy)

    def errors_mm(self, seed: int) -> Float:
        """Maker's errors (rows, columns, 2) for a seed, without the pitch's error."""
        columns, rows = self.lines if self.kind == "line_grid" else self.size
        tolerance = self.node_tolerance_mm
        return np.random.default_rng(seed).uniform(-tolerance, tolerance, (rows, columns, 2))

    def surface(self) -> Surface:
        """Its shape: a plane, or bent."""
        return flat() if self.bow_mm == 0.0 else bowl(self.bow_mm, max(self.half_field_mm()))

    def texture(self, seed: int) -> Texture:
        """Return its print, with the maker's errors of a seed."""
        pitch = self.true_pitch_mm
        if self.kind == "line_grid":
            return line_grid(
                pitch_mm=pitch,
                lines=self.lines,
                line_width_mm=self.line_width_mm,
                node_tolerance_mm=self.node_tolerance_mm,
                dark_lines=self.dark_lines,
                seed=seed,
                edge_sd_mm=self.edge_mm,
                dark=_CHROME,
                bright=_BACKLIT,
            )
        errors = self.errors_mm(seed)
        margin = self.pitch_mm if self.margin_mm is None else self.margin_mm
        if self.kind in ("circles", "circles_asymmetric"):
            return dots_board(
                pitch_mm=pitch,
                errors_mm=errors,
                margin_mm=margin,
                dot_mm=0.5 * self.pitch_mm if self.dot_mm is None else self.dot_mm,
                asymmetric=self.kind == "circles_asymmetric",
                marks=self.marks,
                edge_mm=self.edge_mm,
            )
        charuco = self.kind == "charuco"
        return squares_board(
            charuco_squares(self.size, self.dictionary) if charuco else checkerboard_squares(self.size),
            pitch_mm=pitch,
            errors_mm=errors,
            margin_mm=margin,
            marker_mm=self.marker_mm * (1.0 + self.pitch_error) if charuco else 0.0,
            edge_mm=self.edge_mm,
        )

    def checked(self) -> SimTarget:
        """Return itself.

        Raises
        ------
        ValueError
            A field is missing for its kind or out of range.
        """
        if self.kind not in TARGET_KINDS:
            raise ValueError(f"target.kind must be one of {', '.join(TARGET_KINDS)}, got {self.kind!r}")
        if not _LEAST_PITCH_MM <= self.pitch_mm <= _MOST_PITCH_MM:
            raise ValueError(f"target.pitch_mm is {self.pitch_mm:g}")
        if self.kind == "line_grid":
            if not self.line_width_mm > 0.0:
                raise ValueError(f"target.line_width_mm is {self.line_width_mm:g}")
            if not all(2 <= n <= _MOST_LINES for n in self.lines):
                raise ValueError(f"target.lines must lie between 2 and {_MOST_LINES} each way, got {list(self.lines)}")
        elif not all(_LEAST <= n <= _MOST for n in self.size):
            raise ValueError(f"target.size must lie between {_LEAST} and {_MOST} each way, got {list(self.size)}")
        if self.kind == "charuco" and not 0.0 < self.marker_mm < self.pitch_mm:
            raise ValueError(f"target.marker_mm must lie between 0 and the pitch, got {self.marker_mm:g}")
        if not 0.0 <= self.node_tolerance_mm < 0.1 * self.pitch_mm:
            raise ValueError(f"target.node_tolerance_mm is {self.node_tolerance_mm:g} of a pitch of {self.pitch_mm:g}")
        if not abs(self.pitch_error) < _MOST_PITCH_ERROR:
            raise ValueError(f"target.pitch_error is {self.pitch_error:g}")
        if self.edge_mm is not None and not self.edge_mm > 0.0:
            raise ValueError(f"target.edge_mm is {self.edge_mm:g}")
        return self

    def changed(self, parameters: Mapping[str, Any]) -> SimTarget:
        """Return the target with some of its attributes changed, given as plain numbers and lists."""
        return replace(self, **_fields(parameters)).checked()


def target_from_tables(known: Mapping[str, Any], true: Mapping[str, Any]) -> SimTarget:
    """Read ``[target]`` and, on top of it, ``[sim.target]``."""
    own = ("lines", "line_width_mm") if known.get("kind", "line_grid") == "line_grid" else ("size",)
    for name in ("pitch_mm", *own):
        if name not in known:
            raise KeyError(name)
    wanted = {name: value for name, value in known.items() if name in _FIELDS}
    return SimTarget(**_fields(wanted | dict(true))).checked()


def _pair(name: str, value: Any) -> tuple[int, int]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise ValueError(f"target.{name} must be two numbers, got {value}")
    return int(value[0]), int(value[1])


def _finite(name: str, value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"{name} is {number}")
    return number


_FIELDS: Final = tuple(SimTarget.__dataclass_fields__)
_PAIRS, _TEXTS, _FLAGS = ("lines", "size"), ("kind", "dictionary"), ("dark_lines", "marks")


def _fields(parameters: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in parameters.items():
        if name not in _FIELDS:
            raise ValueError(f"a target has no {name!r}")
        if name in _PAIRS:
            out[name] = _pair(name, value)
        elif name in _TEXTS:
            out[name] = str(value)
        elif name in _FLAGS:
            out[name] = bool(value)
        else:
            out[name] = _finite(name, value)
    return out
