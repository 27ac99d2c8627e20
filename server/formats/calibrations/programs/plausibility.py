"""Plausibility of a calibration over the points of its volume that both cameras see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.conversion import image_positions
from stereorig.core.cameras.lens import OpenCVLens, SeidelLens
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import FileFormatError
from stereorig.server.formats.calibrations.recognise import LoadedCalibration

MAX_RESIDUAL_PX = 1e-3  # of a carried-over model against an independent projection; rounding is 1e-9
_ACROSS = (13, 11)
_DEPTHS = np.geomspace(0.3, 300.0, 61)  # of the baseline
_THICKNESS = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
_MIN_POINTS = 20
#: baselines and stand-offs that two cameras can have: no lens is nearer to another, no specimen farther away
_SHORTEST_MM, _LONGEST_MM = 1.0, 1e5
#: stand-off, and baseline of cameras whose axes do not meet, below which a unit is asked for: less is in front of
#: hardly any lens, while boards' squares, centimetres and inches bring a usual rig there
_NEAR_MM, _NARROW_MM = 30.0, 10.0
_PARALLEL = 50.0  # baselines: axes that meet further away are parallel but for an error, and meet by chance


@dataclass(frozen=True)
class Residual:
    """Epipolar residuals in pixels of camera 2."""

    points: int
    rms_px: float | None
    max_px: float | None

    @staticmethod
    def of(values: Float) -> Residual:
        """Summarise the finite values; the root mean square and the largest are None if there is no point."""
        finite = values[np.isfinite(values)]
        if finite.size == 0:
            return Residual(0, None, None)
        return Residual(int(finite.size), float(np.sqrt(np.mean(finite**2))), float(np.abs(finite).max()))


@dataclass(frozen=True)
class CalibrationCheck:
    """Result of a plausibility check of a calibration.

    Attributes
    ----------
    volume
        Epipolar residual over a grid of points that both cameras see.
    pixels_with_ray
        Share of each image where the lens can be inverted.
    image_size_known
        True if the file states the images' sizes.
    warnings
        Sentences.
    """

    volume: Residual
    pixels_with_ray: dict[str, float]
    baseline_mm: float
    stereo_angle_deg: float
    image_size_known: bool
    warnings: list[str]


def image_sizes(loaded: LoadedCalibration) -> tuple[tuple[int, int], tuple[int, int], bool]:
    """Return both image sizes, and True if the file states them; else twice the principal point, rounded."""
    sizes = []
    for camera, size in ((loaded.pair.cam1, loaded.image_size1_px), (loaded.pair.cam2, loaded.image_size2_px)):
        lens = camera.lens
        assert isinstance(lens, SeidelLens | OpenCVLens)
        sizes.append(size or (_twice(lens.cx_px), _twice(lens.cy_px)))
    return sizes[0], sizes[1], loaded.image_size1_px is not None and loaded.image_size2_px is not None


def _twice(centre_px: float) -> int:
    return round(min(max(2.0 * centre_px + 1.0, 16.0), 1e5))


def middle_depth_mm(pair: StereoPair, size1: tuple[int, int], size2: tuple[int, int]) -> float | None:
    """Return the depth in camera 1 at which the cameras' views overlap best: where the images' middles meet.

    If the cameras' axes do not meet, the depth at which the images share most; None if they share nothing.
    """
    middles = [np.array([(n - 1) / 2 for n in size]) for size in (size1, size2)]
    met = pair.triangulate(*middles)
    if bool(met.valid):
        depth = float(pair.cam1.cam_from_sys.apply(met.xyz_mm)[2])
        if len(_visible_at(pair, size1, size2, depth)):
            return depth
    depths = pair.baseline_mm * _DEPTHS
    counts = np.array([len(_visible_at(pair, size1, size2, float(d))) for d in depths])
    if counts.max() == 0:
        return None
    return float(np.exp(np.log(depths[counts == counts.max()]).mean()))


def length_warning(loaded: LoadedCalibration) -> str | None:
    """Return the question to the user if another program's lengths are likely in another unit than millimetres."""
    if not loaded.imported or loaded.unit is not None:
        return None
    size1, size2, _ = image_sizes(loaded)
    with np.errstate(all="ignore"):  # a file may hold numbers of any size
        met = loaded.pair.triangulate(*(np.array([(n - 1) / 2 for n in size]) for size in (size1, size2)))
    baseline = loaded.pair.baseline_mm
    depth = float(loaded.pair.cam1.cam_from_sys.apply(met.xyz_mm)[2]) if bool(met.valid) else None
    if depth is not None and not 0.0 < depth < _PARALLEL * baseline:
        depth = None
    lengths = [baseline] if depth is None else [baseline, depth]
    if max(lengths) > _LONGEST_MM:
        likely = "It seems to be in micrometres."
    elif min(lengths) < _SHORTEST_MM:
        likely = "It seems to be in metres."
    elif depth < _NEAR_MM if depth is not None else baseline < _NARROW_MM:
        likely = "Is it in squares of the board, centimetres, inches or metres?"
    else:
        return None
    met_at = "" if depth is None else f", and axes that meet at {depth:.3g} mm"
    return (
        f"the unit of T is not stated: a baseline of {baseline:.3g} mm{met_at}? {likely} "
        "State it (--unit, unit of the import): m, or '25 mm' of a board's squares"
    )


def shared_points(pair: StereoPair, size1: tuple[int, int], size2: tuple[int, int]) -> Float:
    """Return points (n, 3) of the system frame that both cameras see: a grid at three depths about the middle.

    The outer depths are those at which both images share nearly half as much as in the middle, 5 % off at most. Empty
    if they share nothing.
    """
    depth = middle_depth_mm(pair, size1, size2)
    if depth is None:
        return np.zeros((0, 3))
    middle = _visible_at(pair, size1, size2, depth)
    for share in _THICKNESS:
        outer = [_visible_at(pair, size1, size2, depth * (1 + s)) for s in (-share, share)]
        if min(map(len, outer)) >= 0.4 * len(middle):
            return np.concatenate([outer[0], middle, outer[1]])
    return middle


def _visible_at(pair: StereoPair, size1: tuple[int, int], size2: tuple[int, int], depth_mm: float) -> Float:
    width, height = size1
    x, y = np.meshgrid(np.linspace(0, width - 1, _ACROSS[0]), np.linspace(0, height - 1, _ACROSS[1]))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    points = pair.cam1.back_project_at_depth(xy, np.full(len(xy), depth_mm))
    image = pair.cam2.project(points.xyz_mm)
    with np.errstate(invalid="ignore"):
        inside = points.valid & image.valid
        inside &= (image.xy > -0.5).all(axis=1) & (image.xy < np.array(size2) - 0.5).all(axis=1)
    return np.asarray(points.xyz_mm[inside])


def independent_projection(camera: Any, points_mm: Float) -> Float:
    """Project points (n, 3) by formulas that are not the measurement's: OpenCV's, or the paper's written out."""
    p = points_mm @ camera.cam_from_sys.rotation.T + camera.cam_from_sys.translation_mm
    lens = camera.lens
    if isinstance(lens, OpenCVLens):
        more = lens.prism.values() if isinstance(lens, OpenCVFullLens) else ()
        bent = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6, *more])
        zero = np.zeros(3)
        distorted = cv2.projectPoints(p.reshape(-1, 1, 3), zero, zero, np.eye(3), bent)[0].reshape(-1, 2)
        x, y = distorted[:, 0], distorted[:, 1]
        return np.stack([lens.fx_px * x + lens.skew_px * y + lens.cx_px, lens.fy_px * y + lens.cy_px], axis=1)
    x, y = lens.phd_px * p[:, 0] / p[:, 2], lens.phd_px * p[:, 1] / p[:, 2]
    shrink = 1.0 + lens.kappa_per_px2 * (x * x + y * y)
    return np.stack([x / shrink + lens.cx_px, lens.aspect * y / shrink + lens.cy_px], axis=1)


def check_calibration(loaded: LoadedCalibration) -> CalibrationCheck:
    """Check a calibration: independent projections of one volume into both cameras must agree with it.

    Raises
    ------
    FileFormatError
        ``calibration_inconsistent`` if the model that was carried over differs from the file's numbers.
    """
    try:
        with np.errstate(all="ignore"):  # a file may hold numbers of any size
            return _checked(loaded)
    except (np.linalg.LinAlgError, cv2.error, ArithmeticError) as error:
        raise FileFormatError(
            f"Nothing can be computed with the calibration's numbers ({error}).",
            code="calibration_inconsistent",
            remedy="Export the calibration again.",
        ) from error


def _checked(loaded: LoadedCalibration) -> CalibrationCheck:
    size1, size2, known = image_sizes(loaded)
    points = shared_points(loaded.pair, size1, size2)
    asked = length_warning(loaded)
    warnings = [*([] if asked is None else [asked]), *loaded.notes]
    residual = Residual(0, None, None)
    if len(points):
        xy1 = independent_projection(loaded.pair.cam1, points)
        xy2 = independent_projection(loaded.pair.cam2, points)
        residual = Residual.of(loaded.pair.epipolar_residual_px(xy1, xy2))
    if residual.points < _MIN_POINTS:
        warnings.append("both cameras see hardly any point in common: the poses or the image sizes may be wrong")
    elif residual.max_px is not None and residual.max_px > MAX_RESIDUAL_PX:
        raise FileFormatError(
            f"The calibration does not agree with its own numbers: points that both cameras see are up to "
            f"{residual.max_px:.3g} px off their epipolar lines.",
            code="calibration_inconsistent",
            remedy="Check the lens terms: the polynomial may fold back inside the image.",
        )
    shares = {}
    for name, camera, size in (("cam1", loaded.pair.cam1, size1), ("cam2", loaded.pair.cam2, size2)):
        shares[name] = float(camera.lens.normalised_from_image(image_positions(size)).valid.mean())
        if shares[name] < 1.0:
            warnings.append(f"{name}: {1 - shares[name]:.1%} of the image has no ray, its lens folds back there")
    if not known:
        warnings.append("the file does not state the image size: twice the principal point was taken")
    return CalibrationCheck(
        volume=residual,
        pixels_with_ray=shares,
        baseline_mm=loaded.pair.baseline_mm,
        stereo_angle_deg=float(np.degrees(loaded.pair.stereo_angle_rad)),
        image_size_known=known,
        warnings=warnings,
    )
