"""Calibrations: read from a file of this or another program, or fitted from images of the target."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from stereorig.core.grid import Localiser
from stereorig.server.formats.calibrations.from_folder import calibrate_folder
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration, parse_calibration


def read_calibration(path: str | Path, *, unit: str | None = None) -> LoadedCalibration:
    """Read a calibration: ``calibration.json``, DICe's XML or text, OpenCV's YAML, and more.

    Parameters
    ----------
    path
        The file; its form is recognised by its content.
    unit
        Unit of length of another program's file: ``um``, ``mm``, ``cm``, ``m``, ``in``, or a size such as ``25 mm``;
        None: millimetres, or as an import states.

    Returns
    -------
    Calibration
        The cameras as ``pair``; the other contents of a ``calibration.json`` as ``record``.

    Raises
    ------
    StereorigError
        ``file_missing``, ``calibration_unreadable``, ``calibration_invalid`` or ``calibration_unsupported``.
    """
    return load_calibration(path, unit=unit)


def calibrate(
    views: str | Path,
    target: str | Path,
    rig: str | Path,
    *,
    hold_out_mm: Sequence[float] = (),
    localiser: Localiser = "profile",
    out: str | Path | None = None,
) -> LoadedCalibration:
    """Calibrate a pair of cameras from images of a target (Helm, McNeill and Sutton 1996, doi:10.1117/1.600624).

    Parameters
    ----------
    views
        Folder of images with camera and travel in the name, as ``cam2_+5.000mm.tif``, or camera and number of a free
        pose, as ``cam2_005.tif``.
    target, rig
        TOML files: the target (``kind``, ``pitch_mm``, ``lines`` or ``size`` ...); the nominal cameras, and in
        ``[calibration]`` the moving part and the lens model.
    hold_out_mm
        Travels, or numbers of free poses, that are left out of the fit, to check it with.
    localiser
        Method for the intersections: ``profile`` or the paper's (``paper``).
    out
        Write ``calibration.json`` there.

    Returns
    -------
    Calibration
        With verdict, covariance and residuals in ``record`` and ``details``.

    Raises
    ------
    StereorigError
        Files that cannot be used, a target that is not found; ``calibration_rejected`` if the verdict is failed.
    """
    found = calibrate_folder(Path(views), Path(target), Path(rig), hold_out=hold_out_mm, localiser=localiser)
    found.check()
    if out is not None:
        found.write(Path(out))
    return parse_calibration(json.dumps(found.content()).encode(), name="calibration.json")
