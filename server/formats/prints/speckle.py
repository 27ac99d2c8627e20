"""Speckle as a drawing: discs of one diameter, one at a random place in each cell of a square lattice."""

from __future__ import annotations

import numpy as np

from stereorig.core.errors import InputError
from stereorig.server.formats.prints.drawing import Discs, PrintedPage
from stereorig.server.formats.prints.page import laid_out, room_mm

_CLEAR_MM = 2.0
_MOST_DISCS = 2_000_000
_LEAST_ACROSS = 10
_LEAST_SHARE, _MOST_SHARE = 0.2, 0.7
_LEAST_PX, _MOST_PX = 3.0, 5.0
_STEPS = 8  # places of a point across a cell, for the expected share
_FINE = 64  # places of a disc's middle across a cell


def speckle_mm(stated_mm: float | None, speckle_px: float, mm_per_px: float | None) -> float:
    """Return a disc's diameter: as stated, else so many pixels.

    Raises
    ------
    InputError
        ``speckle_invalid`` for a size that the images would not resolve; ``nominal_missing`` if a pixel's is not known.
    """
    if stated_mm is not None:
        return stated_mm
    if not _LEAST_PX <= speckle_px <= _MOST_PX:
        raise _invalid(f"A disc would have {speckle_px:g} px", f"Give it {_LEAST_PX:g} to {_MOST_PX:g} px.")
    if mm_per_px is None:
        raise InputError(
            "The speckle's size is not stated, and no rig file states distance and lens.",
            code="nominal_missing",
            remedy="State the size in mm, or a rig file with phd_px and standoff_mm of both cameras.",
        )
    return speckle_px * mm_per_px


def speckle_page(
    diameter_mm: float, *, share: float = 0.5, seed: int = 1, paper: str = "A4", margin_mm: float = 10.0
) -> PrintedPage:
    """Draw speckle over all that the rulers leave of a page; the same seed is the same pattern.

    Parameters
    ----------
    diameter_mm
        Diameter of a disc; 3 to 5 pixels of the image are best.
    share
        Black share of the area.
    seed
        Names the pattern.
    paper, margin_mm
        See :func:`stereorig.server.formats.prints.page.laid_out`.

    Raises
    ------
    InputError
        ``print_page``, ``print_too_large``, ``speckle_invalid`` for a share or a size that no such pattern has.
    """
    if not _LEAST_SHARE <= share <= _MOST_SHARE:
        raise _invalid(f"The black share is {share:g}", f"Give a share from {_LEAST_SHARE:g} to {_MOST_SHARE:g}.")
    if not 0.0 < diameter_mm < np.inf or seed < 0:
        raise _invalid(f"A diameter of {diameter_mm:g} mm or a seed of {seed} is none", "Give positive numbers.")
    title = f"speckle, discs of {diameter_mm:.6g} mm, {100 * share:.6g} % black, seed {seed}"
    size = room_mm(paper, margin_mm, _CLEAR_MM)
    drawing, middle = laid_out(size, paper, margin_mm, _CLEAR_MM, title)
    cell = diameter_mm / diameter_in_cells(share)
    # every disc is whole
    columns, rows = (int((side - diameter_mm) / cell) for side in size)
    if not (min(columns, rows) >= _LEAST_ACROSS and columns * rows <= _MOST_DISCS):
        raise _invalid(
            f"{size[0]:g} x {size[1]:g} mm would have {columns} x {rows} discs of {diameter_mm:g} mm",
            f"Choose size and paper so that {_LEAST_ACROSS} each way and at most {_MOST_DISCS} fit.",
        )
    j, i = np.indices((rows, columns))
    places = np.stack([i, j], axis=-1) + np.random.default_rng(seed).random((rows, columns, 2))
    centres = (places - 0.5 * np.array([columns, rows])) * cell + middle
    drawing.discs.append(Discs(centres.reshape(-1, 2), diameter_mm))
    return drawing


def diameter_in_cells(share: float) -> float:
    """Return the diameter, in cells of the lattice, of discs that are expected to cover a share of the area."""
    from scipy.optimize import brentq  # the web process draws pages, and is not to load it before

    return float(brentq(lambda diameter: _covered(diameter) - share, 0.1, 2.0, xtol=1e-6))


def _covered(diameter: float) -> float:
    """Expected share of the area under discs at a random place of each cell.

    A point is white if no disc covers it; each cell's disc does with the share of the cell that lies within a radius of
    the point. The cells are independent; the share is the mean over the points of one cell.
    """
    radius = 0.5 * diameter
    reach = int(np.ceil(radius))
    at = (np.arange((2 * reach + 1) * _FINE) + 0.5) / _FINE - reach
    white = 0.0
    # by symmetry a quarter of the cell is enough
    points = (np.arange(_STEPS) + 0.5) / (2 * _STEPS)
    for x in points:
        for y in points:
            within = (at - x)[:, None] ** 2 + (at - y)[None, :] ** 2 < radius**2
            cells = within.reshape(2 * reach + 1, _FINE, 2 * reach + 1, _FINE).mean(axis=(1, 3))
            white += float(np.prod(1.0 - cells))
    return 1.0 - white / _STEPS**2


def _invalid(cause: str, remedy: str) -> InputError:
    return InputError(f"{cause}.", code="speckle_invalid", remedy=remedy)
