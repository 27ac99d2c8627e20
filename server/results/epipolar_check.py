"""The epipolar residual of a calibration over points that were measured with another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.orientation.matched import seen_by_camera2
from stereorig.server.formats.calibrations.programs.plausibility import Residual
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.results.provenance import calibration_of
from stereorig.server.results.steps import read_step


@dataclass(frozen=True)
class EpipolarComparison:
    """The epipolar residuals of two calibrations over the points of a result, whose file's name comes first."""

    results: str
    measured_with: Residual
    this_calibration: Residual


def check_against(loaded: LoadedCalibration, files: Sequence[Path], measured_with: Path) -> EpipolarComparison:
    """Return the epipolar residual of a calibration over points that were measured with another.

    Parameters
    ----------
    loaded
        The calibration to check.
    files
        Result files; the first is read.
    measured_with
        The calibration that they were measured with, which gives each point's position in camera 2.

    Raises
    ------
    FileFormatError
        ``calibration_changed`` if it is not the one that the results name.
    InputError
        ``too_few_points`` without a valid point.
    """
    step = read_step(files[0], ["epipolar_px"])
    own = load_calibration(measured_with)
    named = calibration_of(step)
    if named is not None and named != own.sha256:
        raise FileFormatError(
            f"{measured_with} is not the calibration that {files[0].name} was measured with.",
            code="calibration_changed",
            remedy="Give the calibration that the analysis was measured with.",
        )
    ok = step.valid
    if not ok.any():
        raise InputError(f"{files[0].name} has no valid point.", code="too_few_points", remedy="Give other results.")
    variables = step.variables
    xy1 = np.stack([variables[n].values[ok] for n in ("x_px", "y_px")], axis=1)
    xyz = np.stack([variables[n].values[ok] for n in ("x_mm", "y_mm", "z_mm")], axis=1)
    ray1 = own.pair.cam1.rays_cam(xy1)
    xy2 = seen_by_camera2(own.pair, ray1, xyz, variables["epipolar_px"].values[ok].astype(np.float64))
    return EpipolarComparison(
        results=files[0].name,
        measured_with=Residual.of(own.pair.epipolar_residual_px(xy1, xy2)),
        this_calibration=Residual.of(loaded.pair.epipolar_residual_px(xy1, xy2)),
    )
