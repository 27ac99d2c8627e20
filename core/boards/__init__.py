"""Checkerboards, ChArUco boards and grids of dots: their description and their points in an image."""

from core.boards.board import BOARD_KINDS, DEFAULT_DICTIONARY, BoardKind, BoardTarget
from core.boards.detect import detect_board
from core.boards.view import BoardView

__all__ = ["BOARD_KINDS", "DEFAULT_DICTIONARY", "BoardKind", "BoardTarget", "BoardView", "detect_board"]
