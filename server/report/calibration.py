"""The calibration in a report: checks, parameters with their uncertainty, target, or another program's lenses."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from stereorig.core.cameras.camera import ELEVEN_PARAMETER_NAMES
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.calibrations.record import CalibrationRecord, RecordedMeasures
from stereorig.server.report.items import Missing, Value
from stereorig.server.report.source import Source
from stereorig.server.report.steps import MeasuredSteps

_CHECKS = (
    ("rbe_px", "RBE (mean distance of found and projected intersections)", "px"),
    ("raz_mm", "RAZ (mean distance of intersections and found ones, projected back on the target)", "mm"),
    ("nsce", "NSCE (the same over the error that rounding to pixels would make)", ""),
)
_UNITS = {"px2": "1/px\u00b2", "px": "px", "rad": "rad", "mm": "mm"}
_KINDS = {
    "dice_xml": "DICe XML",
    "dice_txt": "DICe text",
    "opencv_yaml": "OpenCV YAML",
    "matchid_caldat": "MatchID caldat",
    "vic3d_xml": "VIC-3D XML",
    "pyvale_txt": "pyvale text",
}


@dataclass(frozen=True)
class CheckRow:
    """One measure over some positions: of both cameras, of camera 1, of camera 2."""

    key: str
    label: str
    unit: str
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Parameter:
    """One parameter of both cameras."""

    key: str
    label: str
    unit: str
    values: tuple[Value, ...]


class CalibrationPart:
    """A calibration's file in a report."""

    def __init__(self, loaded: LoadedCalibration) -> None:
        self._loaded, self._record = loaded, loaded.record
        self.kind = _KINDS.get(loaded.source, loaded.source)

    @property
    def checks(self) -> list[CheckRow]:
        """The measures at fitted and at held-out positions."""
        rows = []
        for name, label, unit in _CHECKS:
            for which, positions in (("fitted", "positions that were fitted"), ("held_out", "held-out positions")):
                found = getattr(self._record.checks, which)
                each = {} if found is None else found.per_camera
                measures = (found, *(each.get(cam) for cam in CAMERAS))
                values = tuple(getattr(m, name) if isinstance(m, RecordedMeasures) else None for m in measures)
                rows.append(CheckRow(f"calibration.{which}.{name}", f"{label}, {positions}", unit, values))
        return rows

    @property
    def made(self) -> list[str]:
        """The checks that were made, and the uncertainty that the calibration leaves."""
        assert self._record.checks is not None
        lines = [f"{c.name.replace('_', ' ')}: {c.text}" for c in self._record.checks.made if c.text]
        found = self._record.uncertainty
        if found.shape_rms_mm is not None:
            text = f"uncertainty that it leaves in shape: {1e3 * found.shape_rms_mm:.3g} \u00b5m rms"
            if found.predicted_shape_rms_mm is not None:
                text += f" ({1e3 * found.predicted_shape_rms_mm:.3g} \u00b5m were predicted)"
            if found.scale is not None:
                text += f", {1e6 * found.scale:.3g} ppm in scale"
            lines.append(text)
        return lines

    @property
    def parameters(self) -> list[Parameter]:
        """The parameters with their standard deviations: the paper's eleven, or OpenCV's and the pose."""
        cameras = {"cam1": self._record.cam1, "cam2": self._record.cam2}
        rows = []
        paper = all(name in found for found in cameras.values() for name in ELEVEN_PARAMETER_NAMES)
        for name in ELEVEN_PARAMETER_NAMES if paper else [n for n in cameras["cam1"] if n in cameras["cam2"]]:
            unit = next((of for end, of in _UNITS.items() if name.endswith(f"_{end}")), "")
            label = name.split("_")[0] if name.endswith("px2") or not unit else name.rsplit("_", 1)[0]
            values = tuple(
                Value(_with_sd(found[name], self._record.sigma.get(f"{cam}.{name}")), found[name])
                for cam, found in cameras.items()
            )
            rows.append(Parameter(f"parameter.{name}", label, unit, values))
        return rows

    @property
    def target(self) -> str:
        """The target, and the method of the calibration."""
        target, origin, tilt = self._record.target, self._record.provenance, self._record.settings.axis_tilt_sigma_rad
        assert target is not None
        more = [
            f"localiser {origin.localiser}" if origin.localiser else "",
            f"{origin.frames} frames averaged at each position" if origin.frames else "",
            f"rig {origin.rig!r}" if origin.rig else "",
            f"stereorig {origin.software_version}" if origin.software_version else "",
            f"axis tilt prior {tilt:g} rad" if tilt else "",
            f"lens model {self._record.lens.model}",
        ]
        made = "; ".join(filter(None, more))
        what = f"pitch {target.pitch_mm:g} mm, maker's tolerance {target.node_tolerance_mm:g} mm"
        if target.lines is not None:
            ground = "dark lines on bright ground" if target.dark_lines else "bright lines on dark ground"
            name = (
                f"grid of {target.lines[0]} x {target.lines[1]} lines, line width {target.line_width_mm:g} mm, {ground}"
            )
        else:
            columns, rows = target.size or (0, 0)
            name = f"{target.kind.replace('_', ', ')} of {columns} x {rows} points"
        return f"Target: {name}, {what}." + (f" Made with {made}." if made else "")

    @property
    def lenses(self) -> list[tuple[str, str, str]]:
        """Camera, lens model and parameters of a file without a record."""
        rows = []
        for name, camera in (("camera 1", self._loaded.pair.cam1), ("camera 2", self._loaded.pair.cam2)):
            lens = camera.lens
            figures: list[tuple[str, object]] = (
                [(f.name, getattr(lens, f.name)) for f in fields(lens)] if is_dataclass(lens) else []
            )
            values = ", ".join(f"{n} = {v:.8g}" for n, v in figures if isinstance(v, int | float))
            rows.append((name, type(lens).__name__, values))
        return rows


def _with_sd(value: float, sd: float | None) -> str:
    if sd is None or not np.isfinite(sd) or sd <= 0.0:
        return f"{value:.8g}" + ("" if sd is None else " (fixed)")
    exponent = int(np.floor(np.log10(sd)))
    if exponent < -7:
        power = int(np.floor(np.log10(max(abs(value), sd))))
        digits = max(power - exponent + 1, 0)
        return f"({value / 10.0**power:.{digits}f} \u00b1 {sd / 10.0**power:.{digits}f}) \u00b7 10^{power}"
    digits = max(1 - exponent, 0)
    return f"{value:.{digits}f} \u00b1 {sd:.{digits}f}"


def calibration_gaps(source: Source, measured: MeasuredSteps) -> list[Missing]:
    """Return the entries that the calibration's record and the analysis' check of it lack."""
    record = CalibrationRecord() if source.calibration is None else source.calibration.record
    gaps = []
    if source.calibration is None:
        remedy = "give the file that the results were measured with (--calibration)"
        gaps.append(Missing("Calibration record", remedy))
    elif record.checks is None:
        remedy = "calibrate with this program, or file the other program's own record with this report"
        gaps.append(Missing("Calibration checks (RBE, RAZ, NSCE), parameters' uncertainty, target, positions", remedy))
    elif record.checks.held_out is None:
        gaps.append(Missing("Calibration checks at held-out positions", "calibrate with held_out_mm"))
    if measured.worst_epipolar is None:
        gaps.append(Missing("Epipolar check of the analysis", "needs at least four measured points"))
    return gaps
