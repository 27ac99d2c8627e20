"""Detection of the declared target of any kind, and the name of another target that an image shows instead."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards.board import BoardTarget
from stereorig.core.boards.detect import detect_board, find_board
from stereorig.core.boards.naming import other_target, shown_target
from stereorig.core.boards.pictures import Pictures
from stereorig.core.boards.view import BoardView
from stereorig.core.errors import TargetError
from stereorig.core.grid import GridOptions, GridView, Localiser, detect_grid, find_grid
from stereorig.core.grid.threshold import checked_image
from stereorig.core.target import GridTarget

# causes that another target than a line grid gives the search for lines
_MAY_BE_OTHER = frozenset(
    {"target_not_found", "target_line_count", "target_partly_seen", "target_dirty", "target_glare", "target_irregular"}
)


def detect_target(
    image: NDArray[Any],
    target: GridTarget | BoardTarget,
    *,
    localiser: Localiser = "profile",
    options: GridOptions | None = None,
) -> GridView | BoardView:
    """Find the target declared, or name the one that is seen.

    Parameters
    ----------
    image
        (rows, columns) gray image.
    target
        Line grid or board.
    localiser, options
        Options for line grids, see :func:`stereorig.core.grid.detect_grid`.

    Returns
    -------
    GridView or BoardView
        After the target's kind.

    Raises
    ------
    ImageError, TargetError
        See :func:`stereorig.core.grid.detect_grid` and :func:`stereorig.core.boards.detect_board`; ``target_other``
        also if a line grid is declared and a board is seen.
    """
    if isinstance(target, BoardTarget):
        return detect_board(image, target)
    try:
        return detect_grid(image, target, localiser=localiser, options=options)
    except TargetError as error:
        raise _named(image, target, error) from error


def find_target(image: NDArray[Any], target: GridTarget | BoardTarget) -> Float:
    """Find the target declared coarsely and fast, for a live picture.

    Returns
    -------
    Float
        (n_x, n_y, 2) points within about half a pixel, indexed as the views of :func:`detect_target`; NaN where hidden.

    Raises
    ------
    ImageError, TargetError
        As :func:`detect_target`, except those that only the fit of the points raises, and without the name of another
        target: after a search without success, :func:`detect_target` gives the cause.
    """
    if isinstance(target, BoardTarget):
        return find_board(image, target)
    return find_grid(image, target)


def _named(image: NDArray[Any], target: GridTarget, error: TargetError) -> TargetError:
    """Return the error that names a board seen in place of a line grid; else the error itself."""
    if error.code not in _MAY_BE_OTHER:
        return error
    shown = shown_target(Pictures(checked_image(np.asarray(image))), with_lines=False)
    if shown is None or _is_its_own(shown.size, target):
        return error
    return other_target(shown, target) or error


def _is_its_own(size: tuple[int, int] | None, target: GridTarget) -> bool:
    """Return True for as many points as the grid's own cells or crossings: a small or blurred grid looks like them."""
    if size is None:
        return False
    return any(sorted(size) == sorted(n - less for n in target.lines) for less in (0, 1, 2))
