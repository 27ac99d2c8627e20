"""Geometry of the rig from the calibration and the measured surface: stereo angle, distance, scale, field of view.

All of it holds at the middle of the measured points, on the plane that fits the surface best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.names import CAMERAS


@dataclass(frozen=True)
class View:
    """One camera before the surface.

    Attributes
    ----------
    standoff_mm
        From the pinhole along the optical axis to the surface's plane.
    scale_mm_per_px
        Along the rows and down the columns, on the surface, at its middle.
    field_of_view_mm
        Width and height of the part of the plane in the image, through the image's middle; None without image size.
    """

    standoff_mm: float
    scale_mm_per_px: tuple[float, float]
    field_of_view_mm: tuple[float, float] | None

    @property
    def mean_scale_mm_per_px(self) -> float:
        """Geometric mean of both directions."""
        return float(np.sqrt(self.scale_mm_per_px[0] * self.scale_mm_per_px[1]))


@dataclass(frozen=True)
class Geometry:
    """Both cameras before the surface.

    Attributes
    ----------
    stereo_angle_rad
        Between the optical axes.
    viewing_angle_rad
        Between both lines of sight to the middle of the measured points.
    baseline_mm
        Between the pinholes.
    views
        By camera.
    """

    stereo_angle_rad: float
    viewing_angle_rad: float
    baseline_mm: float
    views: dict[str, View]


def geometry(
    pair: StereoPair, surface: Field, sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
) -> Geometry | None:
    """Return the geometry of a measurement; None with fewer than four valid points.

    Parameters
    ----------
    pair
        The calibrated cameras.
    surface
        Shape of the reference.
    sizes
        Width and height of both cameras' images.
    """
    points = surface.xyz_mm[surface.valid]
    if len(points) < 4:
        return None
    middle = np.median(points, axis=0)
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    middle = middle - ((middle - points.mean(axis=0)) @ normal) * normal  # onto the plane
    return geometry_at(pair, middle, normal, sizes)


def geometry_at(
    pair: StereoPair, middle: Float, normal: Float, sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
) -> Geometry | None:
    """Return the geometry before a plane; None where a camera does not see it.

    Parameters
    ----------
    pair
        The calibrated cameras.
    middle, normal
        (3,) a point of the plane, mm, and its normal, in the system frame.
    sizes
        Width and height of both cameras' images.
    """
    views: dict[str, View] = {}
    for name, camera, size in zip(CAMERAS, (pair.cam1, pair.cam2), sizes, strict=True):
        view = _view(camera, middle, normal, size)
        if view is None:
            return None
        views[name] = view
    directions_mm = [camera.centre_sys_mm - middle for camera in (pair.cam1, pair.cam2)]
    directions = [s / np.linalg.norm(s) for s in directions_mm]
    return Geometry(
        stereo_angle_rad=pair.stereo_angle_rad,
        viewing_angle_rad=float(np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0))),
        baseline_mm=pair.baseline_mm,
        views=views,
    )


def geometry_of_cameras(
    pair: StereoPair, sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
) -> Geometry | None:
    """Return the geometry before the plane Z = 0 at its origin, or where the optical axes come nearest to each other.

    The origin is the target's of a calibration made here; of another program's it may be a camera's own pinhole. The
    plane through the axes' place is across the mean of both axes. None where the cameras see neither.
    """
    found = geometry_at(pair, np.zeros(3), np.array([0.0, 0.0, 1.0]), sizes)
    if found is not None:
        return found
    one, two = (camera.cam_from_sys.rotation[2] for camera in (pair.cam1, pair.cam2))
    between = pair.cam2.centre_sys_mm - pair.cam1.centre_sys_mm
    if float(np.linalg.norm(np.cross(one, two))) < 1e-6:  # parallel axes meet nowhere
        return None
    along = np.linalg.lstsq(np.column_stack([one, -two]), between, rcond=None)[0]
    ends = pair.cam1.centre_sys_mm + along[0] * one, pair.cam2.centre_sys_mm + along[1] * two
    mean = one + two
    return geometry_at(pair, 0.5 * (ends[0] + ends[1]), mean / np.linalg.norm(mean), sizes)


def _view(camera: Camera, middle: Float, normal: Float, size: tuple[int, int] | None) -> View | None:
    centre = camera.centre_sys_mm
    axis = camera.cam_from_sys.rotation[2]
    slant = float(axis @ normal)
    here = camera.project(middle)
    if not bool(here.valid) or abs(slant) < 1e-6:
        return None
    xy = here.xy

    def on_plane(positions: Float) -> Float:
        return camera.back_project_to_plane(positions, point_sys_mm=middle, normal_sys=normal).xyz_mm

    ends = on_plane(xy + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]))
    scale = (float(np.linalg.norm(ends[1] - ends[0])), float(np.linalg.norm(ends[3] - ends[2])))
    field_of_view = None
    if size is not None:
        width, height = size
        x, y = 0.5 * (width - 1), 0.5 * (height - 1)
        edges = on_plane(np.array([[-0.5, y], [width - 0.5, y], [x, -0.5], [x, height - 0.5]]))
        spans = float(np.linalg.norm(edges[1] - edges[0])), float(np.linalg.norm(edges[3] - edges[2]))
        field_of_view = spans if np.isfinite(spans).all() else None
    return View(
        standoff_mm=float(((middle - centre) @ normal) / slant), scale_mm_per_px=scale, field_of_view_mm=field_of_view
    )
