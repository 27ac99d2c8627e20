"""The calibration's result, printed and drawn."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereorig.server.demo.client import Calibrated
from stereorig.server.demo.session import DemoCheck, DemoRun, table
from stereorig.server.formats.calibrations.record import ChecksRecord

HELD_OUT_LIMIT_PX = 0.1  # the band of a good calibration


@dataclass(frozen=True, eq=False)
class ViewIntersections:
    """One view's intersections (n, 2), and measured minus projected (n, 2)."""

    title: str
    held_out: bool
    xy_px: NDArray[np.float64]
    residual_px: NDArray[np.float64]

    @property
    def rbe_px(self) -> float:
        """Mean distance of found and projected intersections."""
        return float(np.mean(np.linalg.norm(self.residual_px, axis=1)))


@dataclass
class CalibrationReport:
    """Lines to print, figures with limits, and the views' residuals for the picture."""

    lines: list[str] = field(default_factory=list)
    checks: list[DemoCheck] = field(default_factory=list)
    views: list[ViewIntersections] = field(default_factory=list)


def describe(session: DemoRun, made: Calibrated) -> CalibrationReport:
    """Return a calibration's checks and verdict as text, and its residuals for the picture."""
    report = CalibrationReport()
    checks, verdict = made.record.checks or ChecksRecord(), made.record.verdict
    rows = []
    for name, measures in (("fitted", checks.fitted), ("held out", checks.held_out)):
        if measures is not None:
            raz_um = None if measures.raz_mm is None else 1e3 * measures.raz_mm
            rows.append([name, f"{measures.rbe_px:.4f}", f"{raz_um:.3f}", f"{measures.nsce:.4f}"])
    report.lines = [
        "",
        *table(["calibration", "RBE px", "RAZ um", "NSCE"], rows),
        f"verdict: {verdict.level}",
        *(f"  {reason}" for reason in verdict.reasons),
    ]
    if checks.held_out is not None and checks.held_out.rbe_px is not None:
        rbe = checks.held_out.rbe_px
        report.checks = [DemoCheck("held-out RBE of the calibration", "px", rbe, None, rbe, HELD_OUT_LIMIT_PX)]
    for view in session.client.get(f"/calibrations/{made.id}/residuals")["views"]:
        xy = np.asarray(view["found_px"], dtype=np.float64).reshape(-1, 2)
        residual = np.asarray(view["residual_px"], dtype=np.float64).reshape(-1, 2)
        use = np.isfinite(xy).all(axis=1) & np.isfinite(residual).all(axis=1)
        title = f"{view['camera']}, dZ {float(view['dz_mm']):+.3f} mm"
        report.views.append(ViewIntersections(title, bool(view["held_out"]), xy[use], residual[use]))
    return report
