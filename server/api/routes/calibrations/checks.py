"""Checks of a calibration that a user asks for: known distance, second calibration, aspect ratio from images."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, File, Form, Query, UploadFile

from stereorig.core.calibration.checks.measures import focal_lengths_px
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.server.api.models.calibration_checks import (
    AspectReply,
    ComparisonReply,
    DistanceReply,
    DistanceRequest,
    GeometryReply,
)
from stereorig.server.api.protocol.dependencies import CalibrationId, ServiceDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.calibrations.calibrations import complete
from stereorig.server.cell.images import images as read_images
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.calibrations.target_toml import target_of
from stereorig.server.formats.images import read_image
from stereorig.server.report.geometry import geometry_of_cameras
from stereorig.server.results.calibration_checks import (
    KNOWN_DISTANCE,
    NamedImage,
    aspect_of_images,
    compare_loaded,
    distance_of_marks,
    distance_of_target,
    kept_distance,
    plain,
)
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/calibrations", tags=["calibrations"])


def _loaded(service: Service, calibration_id: str) -> LoadedCalibration:
    return load_calibration(complete(service, calibration_id) / "calibration.json")


@router.get(
    "/{calibration_id}/geometry",
    summary="Stereo angle, baseline, focal length, field of view",
    responses=errors(404, 409, 422),
)
def get_geometry(service: ServiceDep, calibration_id: CalibrationId) -> GeometryReply:
    """Return the geometry of the calibrated cameras before the plane of the target, and each camera's parameters."""
    loaded = _loaded(service, calibration_id)
    pair, sizes = loaded.pair, (loaded.image_size1_px, loaded.image_size2_px)
    found = geometry_of_cameras(pair, sizes)
    pitch_um = {cam: service.config.camera(cam).pixel_um for cam in CAMERAS}

    def seen(cam: CameraName) -> dict[str, object]:
        assert found is not None
        view, um, lens = found.views[cam], pitch_um[cam], (pair.cam1 if cam == "cam1" else pair.cam2).lens
        return {
            "focal_length_mm": None if um is None else 1e-3 * um * focal_lengths_px(lens)[0],
            "standoff_mm": view.standoff_mm,
            "field_of_view_mm": view.field_of_view_mm,
            "scale_mm_per_px": view.scale_mm_per_px,
        }

    return GeometryReply.model_validate(
        {
            "stereo_angle_deg": float(np.degrees(pair.stereo_angle_rad)),
            "baseline_mm": pair.baseline_mm,
            "cameras": None if found is None else {cam: seen(cam) for cam in CAMERAS},
            "parameters": {"cam1": pair.cam1.values(), "cam2": pair.cam2.values()},
        }
    )


@router.post(
    "/{calibration_id}/distance:check", summary="Measure a known distance", responses=errors(404, 409, 413, 422, 507)
)
def check_distance(service: ServiceDep, calibration_id: CalibrationId, body: DistanceRequest) -> DistanceReply:
    """Compare a measured with a known distance: the only check that shows a wrong pitch of the target.

    The finding is kept with the calibration, under `kept_checks` and in reports; a later one replaces it.
    """
    if (body.points_px is None) != (body.distance_mm is None):
        raise InputError(
            "distance_mm is the known distance of two marks: it belongs to points_px.",
            code="option_conflict",
            remedy="Give both, or neither where a step's target is measured.",
        )
    loaded = _loaded(service, calibration_id)
    if body.points_px is not None and body.distance_mm is not None:
        found = distance_of_marks(
            loaded,
            np.array([body.points_px.cam1, body.points_px.cam2]),
            body.distance_mm,
            distance_sigma_mm=body.distance_sigma_mm,
            point_sigma_px=body.point_sigma_px,
        )
        how: dict[str, object] = {"points_px": body.points_px.model_dump(mode="json")}
    else:
        assert body.step is not None
        target = target_of(body.step.target.plain(), "step.target")
        step = service.tests.steps.verified(body.step.test_id, body.step.n)
        images = read_image(step.cam1), read_image(step.cam2)
        found = distance_of_target(loaded, images, target, distance_sigma_mm=body.distance_sigma_mm)
        how = body.step.model_dump(mode="json", exclude_none=True)
    kept = kept_distance(found, how)
    service.calibrations.put_check(calibration_id, KNOWN_DISTANCE, kept)
    service.hub.publish("calibration", {"calibration_id": calibration_id})
    return DistanceReply.model_validate(kept)


@router.get(
    "/{calibration_id}/comparison",
    summary="Two calibrations of one rig, compared in space",
    responses=errors(404, 409, 422),
)
def compare_calibration(
    service: ServiceDep,
    calibration_id: CalibrationId,
    other: Annotated[str, Query(alias="with", max_length=40, description="Id of the second calibration.")],
    independent: Annotated[
        bool, Query(description="Other targets, stages and cameras made them, even if both declare them alike.")
    ] = False,
) -> ComparisonReply:
    """Return shape, scale and epipolar offset of the second against this one, in units of both covariances.

    Points of the common volume are imaged by the first calibration's cameras and measured with the second's.
    """
    found = compare_loaded(_loaded(service, calibration_id), _loaded(service, other), independent=independent)
    return ComparisonReply.model_validate(plain(found))


@router.post(":aspect", summary="Aspect ratio from images", responses=errors(413, 422))
def measure_aspect(
    service: ServiceDep,
    images: Annotated[
        list[UploadFile],
        # a form cannot distinguish an empty list from a missing one
        File(min_length=1, description="One camera's images of the line grid at 45 degrees, moved about in its plane."),
    ],
    standoff_mm: Annotated[
        float | None, Form(gt=0.0, le=1e9, allow_inf_nan=False, description="Distance of camera and grid, roughly.")
    ] = None,
) -> AspectReply:
    """Measure rows' scale over columns' scale, section 3.2.2; refused where the grid is tilted or not at 45 degrees.

    The target is the rig file's; nothing is kept. GET /cameras/{cam}/frame?format=tiff gives such images.
    """
    target = target_of(service.config.target.plain(), "the rig file, [target]")
    read = [
        NamedImage(name, decoded.pixels)
        for name, upload in ((u.filename or f"image {k + 1}", u) for k, u in enumerate(images))
        for decoded in read_images(service.cell, {name: upload.file.read()}).values()
    ]
    return AspectReply.model_validate(plain(aspect_of_images(read, target, standoff_mm=standoff_mm)))
