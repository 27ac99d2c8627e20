"""The calibration target: a precision grid of two families of equidistant lines.

Index and frame conventions, the same for every camera: ``lines = (n_a, n_b)``. Walking along X_sys one crosses the
``n_a`` lines of family a; walking along Y_sys, a quarter turn clockwise from it in the image, the ``n_b`` lines of
family b. If the lines are at 45 degrees in the image, X_sys goes right and down and Y_sys left and down; if they are
along rows and columns, X_sys goes right and Y_sys down. In general X_sys is between 23 degrees above the rows and 67
degrees below, unless the other way is asked for (``stereorig.core.grid.GridOptions.orientation``). The origin is the
centre of the full set of lines, Z_sys = 0 is the plane of the grid at the first position. Only inner intersections are
used: the outermost lines end at their crossings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.errors import TargetError

LINE_GRID: Final = "line_grid"
"""Kind of a line grid; the other kinds are :data:`stereorig.core.boards.board.BOARD_KINDS`."""
_MIN_LINES = 5  # three inner lines each way: the fewest that show a lens's curvature


@dataclass(frozen=True, kw_only=True)
class GridTarget:
    """Description of the calibration grid.

    Attributes
    ----------
    pitch_mm
        Distance of neighbouring lines.
    lines
        (n_a, n_b) lines crossed walking along X_sys and along Y_sys.
    line_width_mm
        Width of a line.
    node_tolerance_mm
        The maker's bound on the error of an intersection's position, per axis; 0 for an exact grid.
    pitch_scale_sigma
        Relative standard deviation of the pitch as a whole; 0: exact; None: ``node_tolerance_mm`` over the size.
    flatness_mm
        Bound on the grid's departure from a plane; None: as ``node_tolerance_mm``. It shows in free poses only.
    dark_lines
        Dark lines on bright ground, or bright lines on dark ground.
    missing_lines
        Numbers, from 1, of the lines that the grid lacks: of those crossed walking along X_sys (columns), and along
        Y_sys (rows).

    Raises
    ------
    TargetError
        Code ``target_invalid``, if a number is out of range.
    """

    pitch_mm: float
    lines: tuple[int, int]
    line_width_mm: float
    node_tolerance_mm: float = 0.0
    dark_lines: bool = True
    pitch_scale_sigma: float | None = None
    flatness_mm: float | None = None
    missing_lines: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    def __post_init__(self) -> None:
        object.__setattr__(self, "lines", two_whole_numbers("lines", self.lines))
        if min(self.lines) < _MIN_LINES:
            raise invalid(f"a grid needs at least {_MIN_LINES} lines each way, got {list(self.lines)}")
        columns, rows = (tuple(sorted(set(own))) for own in self.missing_lines)
        object.__setattr__(self, "missing_lines", (columns, rows))
        for own, count in zip((columns, rows), self.lines, strict=True):
            if any(not 1 <= k <= count for k in own) or count - len(own) < _MIN_LINES:
                raise invalid(
                    f"missing_lines must be numbers from 1 to {count} that leave {_MIN_LINES} lines, got {list(own)}"
                )
        check_pitch(self.pitch_mm)
        if not (0.0 < self.line_width_mm < 0.5 * self.pitch_mm):
            raise invalid(
                f"line_width_mm must lie between 0 and half of the pitch ({0.5 * self.pitch_mm:g} mm),"
                f" got {self.line_width_mm!r}"
            )
        check_tolerance(self.node_tolerance_mm, self.pitch_mm)
        check_errors(self.pitch_scale_sigma, self.flatness_mm)

    @property
    def present_lines(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices, from 0, of the lines that the grid has, along X_sys and along Y_sys."""
        return self._present(0), self._present(1)

    def _present(self, axis: int) -> NDArray[np.intp]:
        missing = np.array(self.missing_lines[axis], dtype=np.intp) - 1
        return np.setdiff1d(np.arange(self.lines[axis]), missing)

    def inner_points_mm(self) -> Float:
        """Return the nominal positions of the inner intersections in the system frame.

        Returns
        -------
        Float
            (n_a - 2, n_b - 2, 2) X_sys, Y_sys in mm, indexed [i along X_sys, j along Y_sys]. Z_sys is 0.
        """
        return self._points(1)

    def all_points_mm(self) -> Float:
        """Return the nominal positions of all intersections, the outermost ones too, (n_a, n_b, 2) in mm."""
        return self._points(0)

    def _points(self, margin: int) -> Float:
        x, y = ((np.arange(margin, n - margin, dtype=np.float64) - 0.5 * (n - 1)) * self.pitch_mm for n in self.lines)
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)


def two_whole_numbers(name: str, values: Sequence[int]) -> tuple[int, int]:
    """Return a description's two counts as integers, or raise ``target_invalid``."""
    pair = tuple(values)
    if len(pair) != 2 or any(isinstance(n, bool) or int(n) != n for n in pair):
        raise invalid(f"{name} must be two whole numbers, got {values!r}")
    return int(pair[0]), int(pair[1])


def check_pitch(pitch_mm: float) -> None:
    """Raise ``target_invalid`` for a distance of neighbouring points that no target can have."""
    if not (np.isfinite(pitch_mm) and pitch_mm > 0.0):
        raise invalid(f"pitch_mm must be positive and finite, got {pitch_mm!r}")


def check_tolerance(node_tolerance_mm: float, pitch_mm: float) -> None:
    """Raise ``target_invalid`` for a tolerance that would confuse neighbouring points."""
    if not (0.0 <= node_tolerance_mm < 0.25 * pitch_mm):
        raise invalid(
            f"node_tolerance_mm must lie between 0 and a quarter of the pitch ({0.25 * pitch_mm:g} mm),"
            f" got {node_tolerance_mm!r}"
        )


def check_errors(pitch_scale_sigma: float | None, flatness_mm: float | None) -> None:
    """Raise ``target_invalid`` for errors of a target that are too large for a calibration."""
    if pitch_scale_sigma is not None and not (0.0 <= pitch_scale_sigma < 0.1):
        raise invalid(f"pitch_scale_sigma must lie between 0 and 0.1, got {pitch_scale_sigma!r}")
    if flatness_mm is not None and not (np.isfinite(flatness_mm) and flatness_mm >= 0.0):
        raise invalid(f"flatness_mm must be positive or 0, got {flatness_mm!r}")


def invalid(cause: str) -> TargetError:
    """Return the error for a description that no target can have."""
    return TargetError(cause, code="target_invalid", remedy="Correct the target's description.")
