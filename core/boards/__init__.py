"""Checkerboards, ChArUco boards and grids of dots: their description, their points in an image, and any target's."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.boards.board import BOARD_KINDS, DEFAULT_DICTIONARY, BoardKind, BoardTarget
    from stereorig.core.boards.detect import detect_board, find_board
    from stereorig.core.boards.eccentricity import dot_centre_offset_px
    from stereorig.core.boards.targets import detect_target, find_target
    from stereorig.core.boards.view import BoardView

__all__ = [
    "BOARD_KINDS",
    "DEFAULT_DICTIONARY",
    "BoardKind",
    "BoardTarget",
    "BoardView",
    "detect_board",
    "detect_target",
    "dot_centre_offset_px",
    "find_board",
    "find_target",
]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "board": ("BOARD_KINDS", "DEFAULT_DICTIONARY", "BoardKind", "BoardTarget"),
        "detect": ("detect_board", "find_board"),
        "eccentricity": ("dot_centre_offset_px",),
        "targets": ("detect_target", "find_target"),
        "view": ("BoardView",),
    },
)
