"""A specimen that was found, as a region that an analysis takes and a user can correct."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.seeding.specimen import Specimen
from stereorig.core.settings import MAX_CORNERS, MAX_CUTS

_TOLERANCE_OF_SUBSET = 0.125  # of an outline for the hand: a subset that reaches over by so much shows nothing of it
_MIN_HOLE_OF_SUBSET = 1.0


def region_to_edit(specimen: Specimen, subset_px: int) -> dict[str, Any]:
    """Return the largest part's outline, simplified, and the holes in it, as the API's region has them.

    Parameters
    ----------
    specimen
        The specimen.
    subset_px
        Width of the subsets; holes that are small against it are left out.
    """
    outline = specimen.outlines_px[0]
    inside = [
        hole
        for hole in specimen.holes_px
        if cv2.pointPolygonTest(outline.astype(np.float32), (float(hole[0, 0]), float(hole[0, 1])), False) >= 0
        and cv2.contourArea(hole.astype(np.float32)) >= _MIN_HOLE_OF_SUBSET * subset_px**2
    ]
    inside.sort(key=lambda hole: -cv2.contourArea(hole.astype(np.float32)))
    return {
        "polygon": _simplified(outline, subset_px).tolist(),
        "holes": [_simplified(hole, subset_px).tolist() for hole in inside[:MAX_CUTS]],
    }


def _simplified(corners: Float, subset_px: int) -> Float:
    tolerance = _TOLERANCE_OF_SUBSET * subset_px
    while True:
        found = cv2.approxPolyDP(corners.astype(np.float32), tolerance, True).reshape(-1, 2)
        if len(found) < 3:
            return corners
        if len(found) <= MAX_CORNERS:
            return np.asarray(found, dtype=np.float64)
        tolerance *= 2.0
