"""Check of the calibration by a field's epipolar offset: it shows cameras that were moved since.

A camera that was touched since images all points off their lines by an offset that varies slowly over the image. A
quadratic surface through the points' offsets has little noise left, so hundredths of a pixel show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from core.field.points.result import Field
from core.field.region.trend import smooth_terms

Level = Literal["ok", "warning", "failed"]

WARNING_PX, FAILED_PX = 0.05, 0.1
_MIN_POINTS_FOR_SURFACE = 60
_MIN_POINTS = 4


@dataclass(frozen=True)
class EpipolarCheck:
    """A field's epipolar offset beside the calibration's own.

    Attributes
    ----------
    level
        ``ok``; ``warning`` from 0.05 px above the calibration's own on; ``failed`` from 0.1 px on: no result of this
        field should be reported before the cameras are calibrated again.
    offset_px
        Root mean square of the smooth part of the offset in camera 2, over the valid points.
    own_px
        The calibration's own, from the residuals of its grid; None where it is not known (it counts as zero).
    reason
        One sentence.
    """

    level: Level
    offset_px: float
    own_px: float | None
    reason: str

    def document(self) -> dict[str, Any]:
        """Return the check as plain numbers and texts."""
        return {"level": self.level, "offset_px": self.offset_px, "own_px": self.own_px, "reason": self.reason}


def check_epipolar(field: Field, rbe_px: float | None, *, imported: bool = False) -> EpipolarCheck | None:
    """Compare a field's epipolar offset with the calibration's.

    Parameters
    ----------
    field
        As measured.
    rbe_px
        The calibration's reprojection error (RBE), of held-out positions where there are any. It is one image's, both
        have it, and the offset is stated in one: so the calibration's own offset is up to its sum over both.
    imported
        True for another program's calibration: its own offset is not known, so that a large one is a warning at most,
        and no sign that a camera moved.

    Returns
    -------
    EpipolarCheck or None
        None if too few points are valid.
    """
    valid = field.valid & np.isfinite(field.epipolar_px)
    offset = field.epipolar_px[valid]
    if len(offset) < _MIN_POINTS:
        return None
    terms = smooth_terms(np.column_stack([field.x_px[valid], field.y_px[valid]]))
    design = terms if len(offset) >= _MIN_POINTS_FOR_SURFACE else terms[:, :1]
    smooth = design @ np.linalg.lstsq(design, offset, rcond=1e-9)[0]
    left = float(np.sum((offset - smooth) ** 2)) / max(len(offset) - design.shape[1], 1)
    # less the part that a surface of so many terms explains of noise alone
    square = float(np.mean(smooth**2)) - left * design.shape[1] / len(offset)
    found = float(np.sqrt(max(square, 0.0)))
    own = None if rbe_px is None else 2.0 * rbe_px
    excess = found - (own or 0.0)
    level: Level = "ok" if excess < WARNING_PX else "warning" if excess < FAILED_PX else "failed"
    known = "unknown" if own is None else f"at most {own:.3f} px"
    text = f"camera 2 sees the points {found:.3f} px off their epipolar lines, the calibration's own is {known}"
    if level != "ok" and imported:
        level = "warning"
        text += "; the imported calibration's own error is not known: hold later steps against the reference"
    elif level != "ok":
        text += "; a camera was moved since, or the calibration belongs to another set-up: calibrate again"
    return EpipolarCheck(level, found, own, text)
