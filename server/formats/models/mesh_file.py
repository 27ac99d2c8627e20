"""The content of a finite element program's file, before a surface is made of it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.errors import FileFormatError

#: largest number of numbers in one array of a file
MAX_NUMBERS = 60_000_000
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Nodes, cells and data of the nodes.

    Attributes
    ----------
    points
        (n, 3) positions, in the file's unit.
    cells
        By VTK's number of a cell's kind, (m, k) node indices.
    data
        Arrays (n,) or (n, c) of the nodes by name.
    units
        Unit by array's name, as the file states it; the positions' name is ``""``. Empty if the file states none.
    time
        Time of the state that was read; None if the file has none.
    corners_only
        Number of cells of a higher order that were reduced to their corners.
    """

    points: Float
    cells: Sequence[tuple[int, Index]]
    data: Mapping[str, Float]
    units: Mapping[str, str] = field(default_factory=dict)
    time: float | None = None
    corners_only: int = 0


#: names of displacements, the first of an array of many; others may precede the word, as in "nodal displacement"
DISPLACEMENT = ("displacement", "displacements", "u", "disp", "depl", "displ", "deformation", "d", "depls")


def is_displacement(name: str) -> bool:
    """Return True for a name that means a displacement."""
    words = [word for word in re.findall(r"[a-z]+|[0-9]+", name.lower()) if word not in ("field", "vector")]
    return bool(words) and words[-1] in DISPLACEMENT


def unreadable(cause: str, *, remedy: str | None = None) -> FileFormatError:
    """Return the error for a model's file that cannot be read."""
    return FileFormatError(
        f"The model's file cannot be read: {cause}.",
        code="model_unreadable",
        remedy=remedy or "Export it again as VTU, XDMF or CSV, and check that it was copied whole.",
    )


def whole_number(text: str | None, what: str) -> int:
    """Return the whole number that a file's text states.

    Raises
    ------
    FileFormatError
        ``model_unreadable`` for anything but digits from 0 to 9.
    """
    plain = (text or "").strip()
    if not (plain.isascii() and plain.isdigit() and len(plain) <= 18):
        raise unreadable(f"{what} is no whole number")
    return int(plain)


def require_nodes(numbers: NDArray[Any], n: int) -> Index:
    """Return the numbers of nodes that cells name, each of 0 to n - 1.

    Raises
    ------
    FileFormatError
        ``model_unreadable``.
    """
    outside = np.flatnonzero(~((numbers >= 0) & (numbers < n)))  # NaN too
    if outside.size:
        raise unreadable(
            f"{outside.size} corners of its cells are none of the {n} nodes, first corner {outside[0] + 1}"
        )
    return numbers.astype(np.int64)


def require_count(count: int, what: str) -> None:
    """Raise an error for an array that is larger than any that is read.

    Raises
    ------
    FileFormatError
        ``model_unreadable``.
    """
    if not 0 <= count <= MAX_NUMBERS:
        raise unreadable(
            f"{what} has {count} numbers, {MAX_NUMBERS} at most are read", remedy="Export the measured surface alone."
        )
