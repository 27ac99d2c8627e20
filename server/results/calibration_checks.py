"""Checks of a calibration that a user asks for: known distance, second calibration, aspect ratio from images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.boards import BoardTarget, detect_target
from core.calibration.aspect_images import AspectMeasurement, measure_aspect_normal
from core.calibration.checks.compare import (
    CalibrationComparison,
    UncertainPair,
    common_points_mm,
    compare_calibrations,
    volume_grid_mm,
)
from core.calibration.checks.distance import MARK_SIGMA_PX, DistanceCheck, check_known_distance
from core.calibration.checks.target_distance import check_target_images
from core.calibration.result import COVARIANCE_NAMES
from core.errors import CalibrationInputError, StereorigError
from core.grid import GridView
from core.target import GridTarget
from server.formats.calibrations.native import covariance_in
from server.formats.calibrations.programs.plausibility import image_sizes, shared_points
from server.formats.calibrations.recognise import LoadedCalibration
from server.formats.calibrations.volume import volume_of
from server.formats.version import software_version

KNOWN_DISTANCE = "known_distance"
Images = tuple[NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class NamedImage:
    """An image and its name in messages."""

    name: str
    pixels: NDArray[Any]


def uncertain_pair(loaded: LoadedCalibration) -> UncertainPair:
    """Return a calibration's cameras with their covariance, where the file states it."""
    found = covariance_in(loaded.details, name="calibration.json", pair=loaded.pair)
    names, covariance = (COVARIANCE_NAMES, None) if found is None else found
    return UncertainPair(loaded.pair, names, covariance)


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


def compare_loaded(a: LoadedCalibration, b: LoadedCalibration) -> CalibrationComparison:
    """Compare two calibrations over the volume that both hold for.

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
    return compare_calibrations(uncertain_pair(a), uncertain_pair(b), points)


def aspect_of_images(
    images: Sequence[NamedImage], target: GridTarget | BoardTarget, *, standoff_mm: float | None = None
) -> AspectMeasurement:
    """Measure the aspect ratio of one camera from images of the line grid at 45 degrees, seen along its normal.

    Raises
    ------
    CalibrationInputError
        ``aspect_target`` for another target than a line grid; as :func:`measure_aspect_normal`.
    ImageError, TargetError
        As :func:`core.boards.detect_target`, the image named.
    """
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
    """Return what is kept of a known distance: the finding, its numbers, what it was measured on, and when."""
    made = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return {**plain(found), "measured_on": dict(how), "checked_utc": made, "software_version": software_version()}


def plain(found: object) -> dict[str, Any]:
    """Return a check's numbers as plain values: what is not known is null."""
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
