"""What the calibration found, told and drawn."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from server.demo.session import Check, Session, table

HELD_OUT_LIMIT_PX = 0.1  # the band of a good calibration


@dataclass
class CalibrationReport:
    """Lines to print, figures with limits, and the views' residuals for the picture."""

    lines: list[str] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)


def describe(session: Session, document: dict[str, Any]) -> CalibrationReport:
    """Tell a calibration's checks and verdict, and fetch its residuals for the picture."""
    report = CalibrationReport()
    checks = document["checks"]
    rows = []
    for name in ("fitted", "held_out"):
        measures = checks.get(name)
        if measures is not None:
            rows.append(
                [
                    name.replace("_", " "),
                    f"{measures['rbe_px']:.4f}",
                    f"{1e3 * measures['raz_mm']:.3f}",
                    f"{measures['nsce']:.4f}",
                ]
            )
    verdict = document["verdict"]
    report.lines = [
        "",
        *table(["calibration", "RBE px", "RAZ um", "NSCE"], rows),
        f"verdict: {verdict['level']}",
        *(f"  {reason}" for reason in verdict["reasons"]),
    ]
    held_out = checks.get("held_out")
    if held_out is not None:
        rbe = float(held_out["rbe_px"])
        report.checks = [Check("held-out RBE of the calibration", "px", rbe, None, rbe, HELD_OUT_LIMIT_PX)]
    for view in session.client.get(f"/calibrations/{document['id']}/residuals")["views"]:
        report.views.append(_view(view))
    return report


def _view(view: dict[str, Any]) -> dict[str, Any]:
    xy = np.asarray(view["found_px"], dtype=np.float64).reshape(-1, 2)
    residual = np.asarray(view["residual_px"], dtype=np.float64).reshape(-1, 2)
    use = np.isfinite(xy).all(axis=1) & np.isfinite(residual).all(axis=1)
    return {
        "title": f"{view['camera']}, dZ {float(view['dz_mm']):+.3f} mm",
        "held_out": bool(view["held_out"]),
        "rbe_px": float(np.mean(np.linalg.norm(residual[use], axis=1))),
        "xy_px": xy[use],
        "residual_px": residual[use],
    }
