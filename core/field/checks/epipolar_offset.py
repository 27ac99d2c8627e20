"""Check of the calibration by a field's epipolar offset: it shows cameras that were moved since.

A camera that was touched since images all points off their lines by an offset that varies slowly over the image. A
quadratic surface through the points' offsets has little noise left, so hundredths of a pixel show.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.block_median import block_medians
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.robust import MAD_TO_SIGMA

Level = Literal["ok", "warning", "failed"]

WARNING_PX, FAILED_PX = 0.05, 0.1
_MIN_POINTS_FOR_SURFACE = 60
_MIN_POINTS = 4
MISFIT_PX, MISFIT_MAX_PX = 0.01, 0.02
"""Variation beyond a quadratic from which on it is stated: root mean square, and local over the noise."""
_ROWS_ALONE = 0.25  # share of the growth over the rows: limit along the rows, which noise and a slanted view cause
_BLOCKS, _MIN_REACH = 12, 3  # blocks along the longer side of the field, points of a block at least


@dataclass(frozen=True)
class EpipolarCheck:
    """Comparison of a field's epipolar offset with the calibration's own.

    Attributes
    ----------
    level
        ``ok``; ``warning`` from 0.05 px above the calibration's own on; ``failed`` from 0.1 px on: no result of this
        field should be reported before the cameras are calibrated again.
    offset_px
        Root mean square of the smooth part of the offset in camera 2, over the valid points.
    own_px
        The calibration's own, from the residuals of its grid; None if it is not known (it counts as zero).
    reason
        One sentence, and a second one for a misfit.
    misfit_px, misfit_max_px
        Root mean square and largest value of the remainder of the offset's local medians after the smooth part, less
        the noise: a shape that no moved camera causes, so an error of the lens model or of the calibration.
    misfit_um
        ``misfit_px`` on the surface; None if the points' distance is not known.
    """

    level: Level
    offset_px: float
    own_px: float | None
    reason: str
    misfit_px: float = 0.0
    misfit_max_px: float = 0.0
    misfit_um: float | None = None

    def with_finding(self, finding: str) -> EpipolarCheck:
        """Return the check with a further finding in its reason: at least a warning; the same check without one."""
        if not finding:
            return self
        return replace(self, level="warning" if self.level == "ok" else self.level, reason=f"{self.reason}; {finding}")

    def document(self) -> dict[str, Any]:
        """Return the check as plain numbers and texts."""
        return asdict(self)


def check_epipolar(field: Field, rbe_px: float | None, *, imported: bool = False) -> EpipolarCheck | None:
    """Compare a field's epipolar offset with the calibration's.

    Parameters
    ----------
    field
        As measured.
    rbe_px
        The calibration's reprojection error (RBE), of held-out positions if there are any. It is the error of one
        image, both cameras have it, and the offset is stated in one image: so the calibration's own offset is up to its
        sum over both. It is one image's, both have it, and the offset is stated in one: so the calibration's own offset
        is up to its sum over both.
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
    rms, largest = _misfit(valid, offset - smooth)
    um = _um_per_px(field)
    um = None if um is None else rms * um
    if rms > MISFIT_PX or largest > MISFIT_MAX_PX:
        about = "" if um is None else f", about {um:.2g} um on the surface"
        text += (
            f"; beyond what a moved camera does, the offset varies by {rms:.3f} px rms ({largest:.3f} px at most)"
            f"{about}: an error of the lens model or of the calibration, which no point's uncertainty holds"
        )
    return EpipolarCheck(level, found, own, text, rms, largest, um)


def rows_not_together(field: Field, rbe_px: float | None) -> str | None:
    """Return a sentence about a camera whose rows were not exposed at one instant; None without such a sign.

    A rolling shutter shifts the rows of a moving specimen in proportion to their delay. Offset and displacement, which
    both contain the shift, then grow over the rows and not along them. A changed lens or a moved camera changes both
    directions. Offset and displacement, which share that, then grow over the rows and not along them. Another lens or
    place of a camera changes both ways.

    Parameters
    ----------
    field, rbe_px
        As in :func:`check_epipolar`.
    """
    valid = field.valid & np.isfinite(field.epipolar_px)
    if field.uvw_mm is None or int(valid.sum()) < _MIN_POINTS_FOR_SURFACE:
        return None
    xy = np.column_stack([field.x_px[valid], field.y_px[valid]])
    terms = smooth_terms(xy)
    parts = np.linalg.lstsq(terms, field.epipolar_px[valid], rcond=1e-9)[0]
    grown = abs(float(parts[2]))
    # bends change by a quarter of their coefficient from the middle to a side
    others = max(abs(float(parts[1])), 0.25 * float(np.abs(parts[3:]).max()))
    if grown - 2.0 * (rbe_px or 0.0) < FAILED_PX or others > _ROWS_ALONE * grown:
        return None
    place, moved = (np.linalg.lstsq(terms[:, :3], a[valid], rcond=1e-9)[0] for a in (field.xyz_mm, field.uvw_mm))
    along_x, along_y = (float(np.linalg.norm(moved[k])) / max(float(np.linalg.norm(place[k])), 1e-12) for k in (1, 2))
    share = grown / max(float(np.ptp(xy[:, 1])), 1.0)  # by so much each row is displaced more than the one before
    if along_x > 2.0 * _ROWS_ALONE * share or along_y < _ROWS_ALONE * share:
        return None
    return (
        f"the rows of camera 1 or of camera 2 were not exposed at one instant: the offset grows by {grown:.2f} px over "
        "the rows and not along them, and so does the displacement, as with a rolling shutter before a moving specimen"
    )


def _misfit(valid: Bool, rest_px: Float) -> tuple[float, float]:
    """Root mean square and largest value of the local medians of the remainder (n,) at valid points, less noise."""
    rows, cols = valid.shape
    if len(rest_px) < _MIN_POINTS_FOR_SURFACE:
        return 0.0, 0.0
    on_grid = np.zeros(valid.shape)
    on_grid[valid] = rest_px
    reach = max(_MIN_REACH, max(rows, cols) // _BLOCKS)
    medians = block_medians(on_grid.ravel(), valid.ravel(), valid.shape, reach, otherwise=0.0)[valid.ravel()]
    # neighbours within a subset share their noise, so that a block's median keeps more of it than of independent points
    noise = MAD_TO_SIGMA * float(np.median(np.abs(rest_px - medians)))
    square = float(np.mean(medians**2)) - (noise / 2.0) ** 2
    if square <= 0.0:
        return 0.0, 0.0
    return float(np.sqrt(square)), max(float(np.abs(medians).max()) - noise, 0.0)


def _um_per_px(field: Field) -> float | None:
    """Median length of a pixel of camera 1 on the surface, um."""
    along = np.linalg.norm(np.diff(field.xyz_mm, axis=1), axis=-1) if field.shape[1] > 1 else np.empty(0)
    along = along[np.isfinite(along)] if along.size else along
    if not along.size:
        return None
    return float(1e3 * np.median(along) / (field.x_px[0, 1] - field.x_px[0, 0]))
