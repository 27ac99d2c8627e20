"""What a file of a finite element program holds, before it is a surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.errors import FileFormatError

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
        What the file says of units, by array's name; that of the positions is ``""``. Empty where it says nothing.
    time
        Of the state that was read; None where the file has none.
    """

    points: Float
    cells: Sequence[tuple[int, Index]]
    data: Mapping[str, Float]
    units: Mapping[str, str] = field(default_factory=dict)
    time: float | None = None


def unreadable(cause: str, *, remedy: str | None = None) -> FileFormatError:
    """Return the error for a model's file that cannot be read."""
    return FileFormatError(
        f"The model's file cannot be read: {cause}.",
        code="model_unreadable",
        remedy=remedy or "Export it again as VTU, XDMF or CSV, and check that it was copied whole.",
    )


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
