"""Dots in an image: round outlines of about one size, laid into the grid described, and the dots that mark its axes.

A hollow dot is found by its outer rim like any other. If exactly three dots are hollow, or larger than their
neighbours, and form an L along the grid's axes, they are its orientation marks: X points from the mark at the L's
corner towards the mark in its row, and in a grid with as many columns as rows Y points towards the mark in its column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.boards.board import BoardTarget
from stereorig.core.boards.dot_lattice import (
    Arranged,
    DotLattice,
    Numbers,
    arrange,
    grow,
    missing_positions,
    turned_numbers,
)
from stereorig.core.boards.pictures import Pictures, full_scale

_MIN_AREA_PX = 12
_ROUND = 0.12  # largest share of an outline's area outside its own ellipse, or missing in it
_ROUGH, _ROUGH_PX = 0.035, 0.16  # unroundness of an outline, and that by its pixels, over half of its mean radius
_FLATTEST = 0.04  # least ratio of the second moments' eigenvalues: tilts up to 78 degrees
_SIZES = 1.8  # ratio of lengths within which dots are of one size, marks among them
_LARGER = 1.2  # ratio of lengths of a larger mark to its neighbours
_HOLLOW = 0.5  # share of the contrast across the rim, by which the middle of a hollow dot departs from its ring
_INSIDE = 0.9  # share of a part's dots that must be on the grid described: the others are dirt
Marks = tuple[tuple[int, int], ...]  # (column, row) of three dots, the L's corner first; empty without
_BLOCKS = (0.05, 0.15, 0.0)  # share of the image's longer side; 0: one threshold for the whole image


@dataclass(frozen=True)
class Blobs:
    """Outlines: centres (n, 2), second moments of the areas within (n, 2, 2), and (n,) True where hollow."""

    centres: Float
    moments: Float
    hollow: Bool


@dataclass(frozen=True)
class FoundDots:
    """Dots laid into the description.

    Attributes
    ----------
    centres, moments
        (columns, rows, 2) and (columns, rows, 2, 2); of a missing dot its neighbours'.
    hollow
        (columns, rows).
    marks
        The three orientation marks' (column, row), the corner's first; empty without marks.
    """

    centres: Float
    moments: Float
    hollow: Bool
    marks: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class DotSearch:
    """Result of a search for a grid of dots.

    Attributes
    ----------
    found
        The grid described; None if it was not found.
    counts
        Columns and rows of the largest lattice of dots seen, (0, 0) without any.
    outline_px
        (n, 2) its dots.
    mirrored
        True if only the mirror image of the grid described fits.
    """

    found: FoundDots | None
    counts: tuple[int, int]
    outline_px: Float
    mirrored: bool


def find_dots(pictures: Pictures, target: BoardTarget, *, coarsely: bool = False, marks: Marks = ()) -> DotSearch:
    """Find a grid of dots; ``coarsely``: on the smallest picture only; ``marks``: its orientation marks' positions."""
    best = DotSearch(None, (0, 0), np.zeros((0, 2)), False)
    for picture, scale in pictures.scales(1 if coarsely else 3):
        for dark in (True, False):
            for block in _BLOCKS:
                blobs = find_blobs(picture, dark=dark, block=block, scale=scale)
                lattice = grow(blobs.centres)
                if lattice is None:
                    continue
                arranged = arrange(lattice, target)
                found = _chosen(blobs, arranged, target) if arranged.ways else _by_marks(blobs, lattice, target, marks)
                if found is not None:
                    return DotSearch(found, arranged.counts, blobs.centres[lattice.member], False)
                if len(lattice.member) > len(best.outline_px):
                    outline = blobs.centres[lattice.member]
                    best = DotSearch(None, arranged.counts, outline, arranged.mirrored)
    return best


def find_blobs(grey8: NDArray[np.uint8], *, dark: bool, block: float, scale: float = 1.0) -> Blobs:
    """Find round outlines of about one size; places in a picture ``scale`` times as large."""
    picture = cv2.GaussianBlur(grey8, (3, 3), 0)
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    if block:
        side = int(block * max(grey8.shape)) | 1
        binary = cv2.adaptiveThreshold(picture, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, max(side, 11), 5 if dark else -5)
    else:
        _, binary = cv2.threshold(picture, 0, 255, kind | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    centres, moments, areas = _round_outlines(contours, 0.02 * grey8.size)
    if not len(centres):
        return Blobs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))
    # outer outlines only: the level rises the right way across the rim; a hollow dot's hole has an outline too
    outside, ring, middle = (_level(picture, centres, moments, r) for r in (1.35, 0.8, 0.0))
    contrast = (outside - ring) if dark else (ring - outside)
    depart = (middle - ring) if dark else (ring - middle)
    keep = contrast > 0.0
    keep &= contrast > 0.3 * np.median(contrast[keep]) if keep.any() else keep
    size = np.sqrt(areas)
    # the commonest size: dust and screws are smaller or larger
    logs = np.log(size)
    if keep.any():
        ordered = np.sort(logs[keep])
        reach = np.searchsorted(ordered, ordered + np.log(1.6))
        start = int(np.argmax(reach - np.arange(len(ordered))))
        keep &= np.abs(logs - np.median(ordered[start : reach[start]])) < np.log(_SIZES)
    hollow = depart > _HOLLOW * np.maximum(contrast, 1.0)
    return Blobs(full_scale(centres[keep], scale), moments[keep] * scale**2, hollow[keep])


def _round_outlines(contours: Sequence[NDArray[Any]], largest: float) -> tuple[Float, Float, Float]:
    centres, moments, areas = [], [], []
    for contour in contours:
        if len(contour) < 8:
            continue
        m = cv2.moments(contour)
        area = m["m00"]
        if not _MIN_AREA_PX <= area <= largest:
            continue
        second = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / area
        determinant = second[0, 0] * second[1, 1] - second[0, 1] ** 2
        # an ellipse of these moments has the area 4 pi sqrt(det)
        if determinant <= 0.0 or abs(area / (4.0 * np.pi * np.sqrt(determinant)) - 1.0) > _ROUND:
            continue
        trace = second[0, 0] + second[1, 1]
        if determinant < _FLATTEST * (0.5 * trace) ** 2:
            continue
        if _unround(contour, m["m10"] / area, m["m01"] / area, second) > _ROUGH + _ROUGH_PX * determinant**-0.25:
            continue
        centres.append((m["m10"] / area, m["m01"] / area))
        moments.append(second)
        areas.append(area)
    return np.array(centres).reshape(-1, 2), np.array(moments).reshape(-1, 2, 2), np.array(areas)


def _unround(contour: NDArray[Any], x: float, y: float, second: NDArray[Any]) -> float:
    """Standard deviation of an outline's distance from its centre, as part of its own ellipse's; 0.1 for a square."""
    d = contour.reshape(-1, 2) - np.array([x, y])
    square = np.einsum("ni,ij,nj->n", d, np.linalg.inv(second), d)
    rho = np.sqrt(np.maximum(square, 0.0))
    return float(rho.std() / rho.mean())


def _level(picture: NDArray[Any], centres: Float, moments: Float, radius: float) -> Float:
    """Median grey level (n,) on the ellipse of ``radius`` times each outline."""
    values, vectors = np.linalg.eigh(4.0 * moments)
    root = np.einsum("nij,nj,nkj->nik", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    place = np.rint(centres[:, None] + np.einsum("nij,mj->nmi", root, circle)).astype(int)
    x = np.clip(place[..., 0], 0, picture.shape[1] - 1)
    y = np.clip(place[..., 1], 0, picture.shape[0] - 1)
    return np.asarray(np.median(picture[y, x], axis=1), dtype=np.float64)


def _chosen(blobs: Blobs, arranged: Arranged, target: BoardTarget) -> FoundDots:
    """Choose the arrangement of the grid that its marks determine, else the one that is upright in the image."""
    best: tuple[tuple[float, float], Numbers, tuple[tuple[int, int], ...]] | None = None
    for way in arranged.ways:
        centres = missing_positions(blobs.centres, way, target)
        marks = _marks(blobs, way)
        # the median steps along X and along Y: X to the right, and Y down
        ex, ey = (np.nanmedian(np.diff(centres, axis=k), axis=(0, 1)) for k in (0, 1))
        if target.kind == "circles_asymmetric":
            ey = np.nanmedian(centres[:, 2:] - centres[:, :-2], axis=(0, 1))
        upright = float(ex[0] / np.linalg.norm(ex) + ey[1] / np.linalg.norm(ey))
        asked = 0.0
        if marks:
            corner, *others = np.array(marks)
            towards = np.sum(np.array(others) - corner, axis=0)
            asked = 2.0 * np.sign(towards[0]) + np.sign(towards[1])
        if best is None or (asked, upright) > best[0]:
            best = (asked, upright), way, marks
    assert best is not None  # a lattice that is laid out has one way at least
    _, way, marks = best
    index = np.maximum(way, 0)
    moments = np.where((way >= 0)[..., None, None], blobs.moments[index], np.median(blobs.moments[index], axis=(0, 1)))
    hollow = np.where(way >= 0, blobs.hollow[index], False)
    return FoundDots(missing_positions(blobs.centres, way, target), moments, hollow, marks)


def _by_marks(blobs: Blobs, lattice: DotLattice, target: BoardTarget, known: Marks) -> FoundDots | None:
    """Arrange a part of the grid by its three marks, whose places on the grid are known."""
    if not known or target.kind != "circles":
        return None
    for numbers in turned_numbers(lattice):
        way = np.full(numbers.max(axis=0) + 1, -1, dtype=np.intp)
        way[numbers[:, 0], numbers[:, 1]] = lattice.member
        seen = np.array(_marks(blobs, way))
        if not len(seen):
            continue
        at = numbers + (np.array(known[0]) - seen[0])
        if {tuple(p) for p in seen + (np.array(known[0]) - seen[0])} != set(known):
            continue
        inside = ((at >= 0) & (at < np.array(target.size))).all(axis=1)
        if inside.sum() < _INSIDE * len(at):
            continue
        way = np.full(target.size, -1, dtype=np.intp)
        way[at[inside, 0], at[inside, 1]] = lattice.member[inside]
        index, there = np.maximum(way, 0), way >= 0
        return FoundDots(
            np.where(there[..., None], blobs.centres[index], np.nan),
            np.where(there[..., None, None], blobs.moments[index], np.median(blobs.moments[lattice.member], axis=0)),
            there & blobs.hollow[index],
            known,
        )
    return None


def _marks(blobs: Blobs, way: Numbers) -> tuple[tuple[int, int], ...]:
    """Return the three marks (column, row), the L's corner first; empty if they are not three in an L."""
    index = np.maximum(way, 0)
    hollow = (way >= 0) & blobs.hollow[index]
    size = np.where(way >= 0, np.linalg.det(blobs.moments[index]) ** 0.25, np.nan)
    # the neighbours' size, where perspective and lens change it slowly
    padded = np.pad(size, 1, constant_values=np.nan)
    around = np.stack(
        [
            padded[1 + i : padded.shape[0] - 1 + i, 1 + j : padded.shape[1] - 1 + j]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if (i, j) != (0, 0)
        ]
    )
    around[:, np.isnan(around).all(axis=0)] = np.inf
    larger = (way >= 0) & (size > _LARGER * np.nanmedian(around, axis=0))
    for marked in (hollow, larger):
        places = np.argwhere(marked)
        if len(places) != 3:
            continue
        for k in range(3):
            corner, (p, q) = places[k], np.delete(places, k, axis=0)
            if (p[0] == corner[0] and q[1] == corner[1]) or (p[1] == corner[1] and q[0] == corner[0]):
                return tuple((int(i), int(j)) for i, j in (corner, p, q))
    return ()
