"""Checks of a calibration that a user asks for: known distance, second calibration, aspect ratio from images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget
from stereorig.core.calibration.aspect_images import AspectMeasurement, measure_aspect_normal
from stereorig.core.calibration.checks.compare import (
    CalibrationComparison,
    UncertainPair,
    common_points_mm,
    compare_calibrations,
    volume_grid_mm,
)
from stereorig.core.calibration.checks.distance import MARK_SIGMA_PX, DistanceCheck, check_known_distance
from stereorig.core.calibration.checks.target_distance import check_target_images
from stereorig.core.calibration.inputs import ASSUMED_SCALE_SIGMA
from stereorig.core.calibration.result import COVARIANCE_NAMES
from stereorig.core.errors import CalibrationInputError, FileFormatError, InputError, StereorigError
from stereorig.core.grid import GridView
from stereorig.core.orientation.matched import seen_by_camera2
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.native import parameters_in
from stereorig.server.formats.calibrations.programs.plausibility import Residual, image_sizes, shared_points
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.calibrations.volume import volume_of
from stereorig.server.formats.version import software_version
from stereorig.server.results.provenance import calibration_of
from stereorig.server.results.steps import read_step

KNOWN_DISTANCE = "known_distance"
Images = tuple[NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class NamedImage:
    """An image and its name in messages."""

    name: str
    pixels: NDArray[Any]


def uncertain_pair(loaded: LoadedCalibration) -> UncertainPair:
    """Return a calibration's cameras with their covariance and its causes, where the file states them."""
    found = parameters_in(loaded.details, name="calibration.json", pair=loaded.pair)
    if found is None:
        return UncertainPair(loaded.pair, COVARIANCE_NAMES, None)
    names = tuple(found.names)
    shared: dict[str, Float] = {}
    if found.by_cause is not None:
        settings = loaded.details.get("settings")
        # errors of single positions are new in each calibration
        steps = isinstance(settings, Mapping) and settings.get("stage_step_sigma_mm") == 0.0
        shared |= {c: L for c, L in found.roots().items() if c == "target" or (c == "stage" and steps)}
    # an aspect ratio that is held has no part in the estimate: its correlations count as its own error
    aspects = [k for k, n in enumerate(names) if n.endswith(".aspect") and found.covariance[k, k] > 0.0]
    if aspects:
        shared["aspect"] = found.covariance[:, aspects] / np.sqrt(np.diagonal(found.covariance)[aspects])
    return UncertainPair(loaded.pair, names, found.covariance, shared)


def _shared(a: LoadedCalibration, b: LoadedCalibration) -> set[str]:
    """Names of the causes that both calibrations declare alike: one target, one stage, aspect ratios that were held."""
    of_stage = ("moves", "stage_scale_sigma", "stage_step_sigma_mm", "axis_tilt_sigma_rad")
    settings = [found.details.get("settings") for found in (a, b)]
    found = set()
    if a.details.get("target") == b.details.get("target") is not None:
        found.add("target")
    if all(isinstance(s, Mapping) for s in settings):
        one, two = ({k: s.get(k) for k in of_stage} for s in settings if isinstance(s, Mapping))
        for stated in (one, two):
            if stated["stage_scale_sigma"] is None:
                stated["stage_scale_sigma"] = ASSUMED_SCALE_SIGMA
        found |= {"stage"} if one == two else set()
    aspects = [[v for n, v in c.pair.values().items() if n.endswith(".aspect")] for c in (a, b)]
    return found | ({"aspect"} if aspects[0] == aspects[1] else set())


def distance_of_marks(
    loaded: LoadedCalibration,
    points_px: Float,
    distance_mm: float,
    *,
    distance_sigma_mm: float = 0.0,
    point_sigma_px: float = MARK_SIGMA_PX,
) -> DistanceCheck:
    """Compare the distance of two marks, (camera, mark, xy), with the known one; see :func:`check_known_distance`."""
    known = uncertain_pair(loaded)
    return check_known_distance(
        known.pair,
        points_px,
        distance_mm,
        covariance=known.covariance,
        names=known.names,
        localisation_sigma_px=point_sigma_px,
        distance_sigma_mm=distance_sigma_mm,
    )


def distance_of_target(
    loaded: LoadedCalibration, images: Images, target: GridTarget | BoardTarget, *, distance_sigma_mm: float = 0.0
) -> DistanceCheck:
    """Compare the size of a target in a pair of images with its description; see :func:`check_target_images`."""
    known = uncertain_pair(loaded)
    return check_target_images(
        known.pair, images, target, covariance=known.covariance, names=known.names, distance_sigma_mm=distance_sigma_mm
    )


def compare_loaded(a: LoadedCalibration, b: LoadedCalibration, *, independent: bool = False) -> CalibrationComparison:
    """Compare two calibrations over the volume that both hold for.

    Target, stage and held aspect ratios that both declare alike count as the same unless they are ``independent``.

    Raises
    ------
    CalibrationInputError
        ``calibrations_apart``: other image sizes, or hardly a point in common.
    """
    sizes_a, sizes_b = image_sizes(a), image_sizes(b)
    if sizes_a[2] and sizes_b[2] and sizes_a[:2] != sizes_b[:2]:
        raise CalibrationInputError(
            f"The images of one calibration are {_sizes(sizes_a)}, of the other {_sizes(sizes_b)}.",
            code="calibrations_apart",
            remedy="Compare calibrations of the same cameras.",
        )
    sizes = sizes_a[:2] if sizes_a[2] else sizes_b[:2]
    volumes = volume_of(a), volume_of(b)
    grid = shared_points(a.pair, *sizes) if volumes[0] is None else volume_grid_mm(volumes[0], sizes[0])
    points = common_points_mm(grid, a.pair, b.pair, sizes, volume_a=volumes[0], volume_b=volumes[1])
    same = set() if independent else _shared(a, b)
    known = (uncertain_pair(c) for c in (a, b))
    one, two = (replace(c, shared={n: L for n, L in c.shared.items() if n in same}) for c in known)
    return compare_calibrations(one, two, points)


def aspect_of_images(
    images: Sequence[NamedImage], target: GridTarget | BoardTarget, *, standoff_mm: float | None = None
) -> AspectMeasurement:
    """Measure the aspect ratio of one camera from images of the line grid at 45 degrees, seen along its normal.

    Raises
    ------
    CalibrationInputError
        ``aspect_target`` for another target than a line grid; as :func:`measure_aspect_normal`.
    ImageError, TargetError
        As :func:`stereorig.core.boards.detect_target`, the image named.
    """
    from stereorig.core.boards import detect_target  # slow to load, and not every start needs it

    if not isinstance(target, GridTarget):
        raise CalibrationInputError(
            f"The aspect ratio is measured on a line grid at 45 degrees, not on a target of kind {target.kind}.",
            code="aspect_target",
            remedy="Calibrate with free poses of the target (moves = 'free'): the aspect ratio is one of the unknowns.",
        )
    views: list[GridView] = []
    for image in images:
        try:
            view = detect_target(image.pixels, target)
        except StereorigError as error:
            raise type(error)(
                f"{image.name}: {error.cause}", code=error.code, remedy=error.remedy, **error.context
            ) from error
        assert isinstance(view, GridView)  # of a line grid
        views.append(view)
    return measure_aspect_normal(views, standoff_mm=standoff_mm, names=[image.name for image in images])


def kept_distance(found: DistanceCheck, how: Mapping[str, object]) -> dict[str, object]:
    """Return the stored record of a known distance: the finding, its numbers, the measured object, and the time."""
    made = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return {**plain(found), "measured_on": dict(how), "checked_utc": made, "software_version": software_version()}


def plain(found: object) -> dict[str, Any]:
    """Return a check's numbers as plain values: unknown ones are null."""
    assert is_dataclass(found)
    assert not isinstance(found, type)
    return dict(_plain(asdict(found)))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _sizes(sizes: tuple[tuple[int, int], tuple[int, int], bool]) -> str:
    return " and ".join(f"{w} x {h} px" for w, h in sizes[:2])


# The epipolar residual of a calibration over points that were measured with another.


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
