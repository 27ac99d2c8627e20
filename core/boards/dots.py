"""Grids of dots: blobs of one size, arranged by OpenCV, then each fitted as an ellipse with a blurred rim."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.boards.board import BoardTarget
from core.boards.models import dot
from core.boards.view import neighbour_distances_px
from core.boards.windows import fit_windows, sample

_MIN_AREA_PX = 12
_MAX_RADIUS_PX = 60
_ROUND = 0.12  # largest share of a blob's area that may lie outside its own ellipse, or lack in it


def find_dots(grey8: NDArray[np.uint8], target: BoardTarget) -> tuple[Float, Float] | None:
    """Return coarse centres (columns, rows, 2) and second moments (columns, rows, 2, 2); None where not found."""
    for dark in (True, False):
        for block in (0.05, 0.15, 0.0):
            centres, moments = _blobs(grey8, dark=dark, block=block)
            if len(centres) < target.size[0] * target.size[1]:
                continue
            arranged = _arranged(centres, target)
            if arranged is None:
                continue
            nearest = np.linalg.norm(centres[None] - arranged.reshape(-1, 1, 2), axis=-1).argmin(axis=1)
            return arranged, moments[nearest].reshape(*target.size, 2, 2)
    return None


def count_dots(grey8: NDArray[np.uint8]) -> int:
    """Return the number of round blobs of about one size."""
    return max(len(_blobs(grey8, dark=dark, block=0.05)[0]) for dark in (True, False))


def refine_dots(grey: Float, coarse_px: Float, moments_px2: Float, target: BoardTarget) -> tuple[Float, Float, Float]:
    """Fit each dot's rim.

    Returns
    -------
    xy_px, sigma_px, radius_px
        (columns, rows, 2) centres of the ellipses, and (columns, rows) each; NaN where a dot cannot be fitted.
    """
    shape = coarse_px.shape[:2]
    xy0 = coarse_px.reshape(-1, 2)
    pitch = neighbour_distances_px(coarse_px, target).ravel()
    # a uniform ellipse has second moments of a quarter of its squared axes: M = (4 moments)^(-1/2)
    values, vectors = np.linalg.eigh(4.0 * moments_px2.reshape(-1, 2, 2))
    matrix = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0.25) ** -0.5, vectors)
    axis = np.sqrt(np.maximum(values[:, 1], 0.25))
    reach = np.minimum(axis + 4.0, np.maximum(pitch - axis - 1.0, axis + 1.0))
    radius = int(np.clip(np.ceil(np.nanmedian(reach)), 3, _MAX_RADIUS_PX))
    ground, top = _levels(grey, xy0, axis, reach)
    start = np.column_stack(
        [xy0, matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1], ground, top - ground, np.full(len(xy0), 0.8)]
    )
    rings = reach / axis

    def weight_of(index: NDArray[np.intp], dx: Float, dy: Float) -> Float:
        d = np.einsum("nij,nmj->nmi", matrix[index], np.stack([dx, dy], axis=-1))
        return np.asarray(np.linalg.norm(d, axis=-1) <= rings[index][:, None], dtype=np.float64)

    fit = fit_windows(grey, start, radius, weight_of, dot)
    a, b, c = fit.parameters[:, 2], fit.parameters[:, 3], fit.parameters[:, 4]
    determinant = a * c - b * b
    good = fit.good & (determinant > 0.0)
    good &= np.linalg.norm(fit.parameters[:, :2] - xy0, axis=1) < 0.5 * axis
    mean_radius = np.where(good, np.maximum(determinant, 1e-12) ** -0.5, np.nan)
    xy = np.where(good[:, None], fit.parameters[:, :2], np.nan)
    return (xy.reshape(*shape, 2), np.where(good, fit.sigma_px, np.nan).reshape(shape), mean_radius.reshape(shape))


def _levels(grey: Float, xy: Float, axis: Float, reach: Float) -> tuple[Float, Float]:
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def at(radius: Float) -> Float:
        return np.asarray(np.median(sample(grey, xy[:, None, :] + radius[:, None, None] * ring), axis=1))

    return at(np.minimum(reach, axis + 3.0)), at(0.4 * axis)


def _blobs(grey8: NDArray[np.uint8], *, dark: bool, block: float) -> tuple[Float, Float]:
    """Centres (n, 2) and second moments (n, 2, 2) of round blobs of about one size."""
    picture = cv2.GaussianBlur(grey8, (3, 3), 0)
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    if block:
        side = int(block * max(grey8.shape)) | 1
        binary = cv2.adaptiveThreshold(picture, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, max(side, 11), 5 if dark else -5)
    else:
        _, binary = cv2.threshold(picture, 0, 255, kind | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    centres, moments, areas = [], [], []
    largest = 0.02 * grey8.size
    for contour in contours:
        m = cv2.moments(contour)
        area = m["m00"]
        if not _MIN_AREA_PX <= area <= largest:
            continue
        second = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / area
        determinant = float(np.linalg.det(second))
        # an ellipse of these moments has the area 4 pi sqrt(det)
        if determinant <= 0.0 or abs(area / (4.0 * np.pi * np.sqrt(determinant)) - 1.0) > _ROUND:
            continue
        values = np.linalg.eigvalsh(second)
        if values[0] < 0.04 * values[1]:
            continue
        inside = binary[int(m["m01"] / area + 0.5), int(m["m10"] / area + 0.5)]
        if not inside:
            continue
        centres.append((m["m10"] / area, m["m01"] / area))
        moments.append(second)
        areas.append(area)
    if not centres:
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    size = np.sqrt(np.array(areas))
    # the commonest size: dust and screws are smaller or larger
    support = [(np.abs(np.log(size / s)) < np.log(1.6)).sum() for s in size]
    keep = np.abs(np.log(size / np.median(size[np.array(support) == max(support)]))) < np.log(1.8)
    return np.array(centres)[keep], np.array(moments)[keep]


def _arranged(centres: Float, target: BoardTarget) -> Float | None:
    points = centres.astype(np.float32).reshape(-1, 1, 2)
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.kind == "circles_asymmetric" else cv2.CALIB_CB_SYMMETRIC_GRID
    count = target.size[0] * target.size[1]
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        try:
            # without a detector of blobs the "image" is the list of points itself; the types do not know it
            found, grid = cv2.findCirclesGrid(points, target.size, flags, None, cv2.CirclesGridFinderParameters())  # type: ignore[call-overload]
        except cv2.error:
            continue
        if found and grid is not None and len(grid) == count:
            return np.swapaxes(np.asarray(grid, dtype=np.float64).reshape(target.size[1], target.size[0], 2), 0, 1)
    return None
