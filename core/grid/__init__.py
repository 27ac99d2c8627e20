"""Grid detection from the target's description alone: section 3.2.2's image processing, and a better localiser."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.grid.detect import detect_grid, find_grid, lines_shown
    from stereorig.core.grid.view import GridOptions, GridView, LineModel, LineOffsets, Localiser, Orientation

__all__ = [
    "GridOptions",
    "GridView",
    "LineModel",
    "LineOffsets",
    "Localiser",
    "Orientation",
    "detect_grid",
    "find_grid",
    "lines_shown",
]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "detect": ("detect_grid", "find_grid", "lines_shown"),
        "view": ("GridOptions", "GridView", "LineModel", "LineOffsets", "Localiser", "Orientation"),
    },
)
