"""Calibrations in other programs' forms, each read back and compared before it is given away."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.conversion import LensFit, fit_opencv, fit_seidel
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.programs.dice_xml import dice_text
from stereorig.server.formats.calibrations.programs.matchid_caldat import caldat_text
from stereorig.server.formats.calibrations.programs.opencv_yaml import opencv_text
from stereorig.server.formats.calibrations.programs.plausibility import (
    Residual,
    image_sizes,
    independent_projection,
    middle_depth_mm,
    shared_points,
)
from stereorig.server.formats.calibrations.programs.vic3d_xml import vic3d_text
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, imported_content, parse_calibration
from stereorig.server.formats.version import software_version

CalibrationForm = Literal["json", "paper", "opencv", "dice", "matchid", "vic3d"]
FORMS: tuple[CalibrationForm, ...] = get_args(CalibrationForm)
FILE_NAMES: dict[CalibrationForm, str] = {
    "json": "calibration.json",
    "paper": "calibration_paper.json",
    "opencv": "calibration_opencv.yaml",
    "dice": "calibration_dice.xml",
    "matchid": "calibration.caldat",
    "vic3d": "calibration_vic3d.xml",
}
MEDIA_TYPES: dict[CalibrationForm, str] = {
    "json": "application/json",
    "paper": "application/json",
    "opencv": "text/x-opencv-storage",
    "dice": "application/xml",
    "matchid": "text/plain; charset=utf-8",
    "vic3d": "application/xml",
}
_ROUNDING_PX = 1e-9
_SKEW = {"opencv": False, "dice": False, "matchid": True, "vic3d": True}
_TANGENTIAL = {"opencv": True, "dice": True, "matchid": True, "vic3d": False}
_RATIONAL = {"opencv": True, "dice": False, "matchid": False, "vic3d": False}
_NOTES: dict[CalibrationForm, tuple[str, ...]] = {
    "json": (),
    "paper": ("covariance, checks and verdict are not carried over",),
    "opencv": ("OpenCV's functions have no skew",),
    "dice": ("camera 0 is camera 1 here; extrinsics relative from camera to camera",),
    "matchid": ("the format is not published: angles taken as R = Rz(Psi) Ry(Phi) Rx(Theta) in degrees",),
    "vic3d": (
        "the lens polynomial is not published: 1 + k1 r^2 + k2 r^4 + k3 r^6 in normalised coordinates was taken",
        "the world lies between the cameras, X along the baseline, Z towards the cameras",
    ),
}


@dataclass(frozen=True)
class LensError:
    """Error of a fitted lens over the image."""

    rms_px: float
    max_px: float


@dataclass(frozen=True)
class ReadBack(Residual):
    """Epipolar and triangulation errors of the written file, over points that both cameras see."""

    rms_mm: float | None
    max_mm: float | None


@dataclass(frozen=True)
class ConversionReport:
    """Report of a calibration's conversion into another form.

    Attributes
    ----------
    format, software
        The written format, and the version that wrote it.
    source, source_sha256
        The calibration that was read.
    units, frame, image_size_px
        Units of length, system frame and image size (width, height) of both cameras in the written file.
    exact
        True if both lenses are the same but for rounding.
    lens
        By camera, the error of the fit.
    read_back
        Over a grid of points that both cameras see, projected by independent formulas with the original.
    notes
        Assumptions that were made.
    """

    format: CalibrationForm
    software: str
    source: str
    source_sha256: str
    units: str
    frame: str
    image_size_px: list[list[int]] | None
    exact: bool
    lens: dict[str, LensError]
    read_back: ReadBack
    notes: list[str]


@dataclass(frozen=True)
class ConvertedCalibration:
    """A calibration in another form: the file's bytes, and the report of the conversion."""

    data: bytes
    report: ConversionReport


def convert_calibration(loaded: LoadedCalibration, form: CalibrationForm, original: bytes) -> ConvertedCalibration:
    """Write a calibration in another form.

    Parameters
    ----------
    loaded
        The calibration that was read.
    form
        ``json``: as this program keeps it, another program's file whole within; ``paper``: the eleven parameters of
        each camera; else another program's.
    original
        The bytes that were read.

    Raises
    ------
    CalibrationError
        ``lens_unfittable``; ``lens_not_held`` where the form has no thin prism or tilted sensor.
    FileFormatError
        If the written file cannot be read back.
    """
    try:
        with np.errstate(all="ignore"):  # a file may hold numbers of any size
            return _convert(loaded, form, original)
    except (np.linalg.LinAlgError, cv2.error, ArithmeticError) as error:
        raise CalibrationError(
            f"The lenses cannot be fitted: {error}.", code="lens_unfittable", remedy="Check the calibration's numbers."
        ) from error


def _convert(loaded: LoadedCalibration, form: CalibrationForm, original: bytes) -> ConvertedCalibration:
    size1, size2, known = image_sizes(loaded)
    cameras, sizes = (loaded.pair.cam1, loaded.pair.cam2), (size1, size2)
    for name, camera in zip(CAMERAS, cameras, strict=True):
        if isinstance(camera.lens, OpenCVFullLens) and form not in ("json", "opencv"):
            terms = ", ".join(f"{key} = {value:.3g}" for key, value in camera.lens.prism.items() if value)
            raise CalibrationError(
                f"The form {form} has no thin prism and no tilted sensor; {name} has {terms}.",
                code="lens_not_held",
                remedy="Write the form json or opencv, which hold them, or calibrate with a lens without these terms.",
            )
    if form == "json":
        content = imported_content(original, name="The calibration", unit=loaded.unit)
        data = (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
        fits = [LensFit(camera.lens, 0.0, 0.0, 1.0) for camera in cameras]
    elif form == "paper":
        fits = [fit_seidel(camera.lens, size) for camera, size in zip(cameras, sizes, strict=True)]
        data = _paper(loaded, fits, sizes if known else None)
    else:
        fits = [
            fit_opencv(camera.lens, size, skew=_SKEW[form], tangential=_TANGENTIAL[form], rational=_RATIONAL[form])
            for camera, size in zip(cameras, sizes, strict=True)
        ]
        data = _other(loaded, form, fits, sizes if known else None).encode()
    exact = all(fit.max_px < _ROUNDING_PX for fit in fits)
    own = loaded.source == "calibration_json"
    report = ConversionReport(
        format=form,
        software=f"stereorig {software_version()}",
        source=loaded.source,
        source_sha256=loaded.sha256,
        units="mm, px, pixel centres at integers",
        frame="target" if own and form in ("json", "paper") else "camera 1",
        image_size_px=[list(s) for s in sizes] if known else None,
        exact=exact,
        lens={f"cam{k + 1}": LensError(f.rms_px, f.max_px) for k, f in enumerate(fits)},
        read_back=read_back(loaded.pair, parse_calibration(data, name="The written file").pair, size1, size2),
        notes=list(_NOTES[form]) + ([] if known else ["image size not known: twice the principal point was taken"]),
    )
    return ConvertedCalibration(data, report)


def read_back(pair: StereoPair, again: StereoPair, size1: tuple[int, int], size2: tuple[int, int]) -> ReadBack:
    """Return a pair's errors at the image positions to which another one projects points of the shared volume."""
    points = shared_points(pair, size1, size2)
    if not len(points):
        return ReadBack(0, None, None, None, None)
    xy1, xy2 = (independent_projection(camera, points) for camera in (pair.cam1, pair.cam2))
    found = again.triangulate(xy1, xy2)
    # each pair has its own system frame: both are compared in camera 1's
    off = np.linalg.norm(again.cam1.cam_from_sys.apply(found.xyz_mm) - pair.cam1.cam_from_sys.apply(points), axis=1)
    off = off[found.valid]
    residual = Residual.of(again.epipolar_residual_px(xy1, xy2))
    return ReadBack(
        points=residual.points,
        rms_px=residual.rms_px,
        max_px=residual.max_px,
        rms_mm=float(np.sqrt(np.mean(off**2))) if off.size else None,
        max_mm=float(off.max()) if off.size else None,
    )


def _paper(
    loaded: LoadedCalibration, fits: list[LensFit], sizes: tuple[tuple[int, int], tuple[int, int]] | None
) -> bytes:
    content: dict[str, object] = {"format": "stereorig calibration", "format_version": 1}
    pair, size = loaded.pair, sizes or image_sizes(loaded)[:2]
    to_sys = RigidTransform.identity()
    if min(camera.cam_from_sys.translation_mm[2] for camera in (pair.cam1, pair.cam2)) <= 0.0:
        # the paper's system frame: its origin is in the middle of the cameras' common view, its axes are camera 1's
        depth = middle_depth_mm(pair, *size)
        if depth is None:
            raise CalibrationError(
                "Both cameras see nothing in common.",
                code="lens_unfittable",
                remedy="Check the calibration and the image sizes.",
            )
        to_sys = pair.cam1.sys_from_cam @ RigidTransform(np.eye(3), np.array([0.0, 0.0, depth]))
    for name, camera, fit in zip(CAMERAS, (pair.cam1, pair.cam2), fits, strict=True):
        content[name] = Camera(fit.lens, camera.cam_from_sys @ to_sys).paper_parameters()
    if sizes is not None:
        content["image_size_px"] = {f"cam{k + 1}": list(size) for k, size in enumerate(sizes)}
    content["provenance"] = {
        "converted_from": loaded.source,
        "sha256": loaded.sha256,
        "software": f"stereorig {software_version()}",
    }
    return (json.dumps(content, indent=1) + "\n").encode()


def _other(
    loaded: LoadedCalibration,
    form: CalibrationForm,
    fits: list[LensFit],
    sizes: tuple[tuple[int, int], tuple[int, int]] | None,
) -> str:
    one, two = (fit.lens for fit in fits)
    assert isinstance(one, OpenCVLens)
    assert isinstance(two, OpenCVLens)
    comment = (
        f"stereorig {software_version()}, from {loaded.source}, SHA-256 {loaded.sha256}; mm, px, degrees or radians as "
        "the format has them; X_cam2 = R X_cam1 + T"
    )
    if form == "opencv":
        return opencv_text(one, two, loaded.pair, sizes, comment)
    if form == "dice":
        return dice_text(one, two, loaded.pair, sizes, comment)
    if form == "matchid":
        return caldat_text(one, two, loaded.pair)
    return vic3d_text(one, two, loaded.pair, comment)
