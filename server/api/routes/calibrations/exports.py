"""Calibrations in other programs' forms."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import Response

from stereorig.server.api.models import ConversionReply
from stereorig.server.api.protocol.dependencies import CalibrationId, ServiceDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.calibrations.calibrations import complete
from stereorig.server.formats.calibrations.export import (
    FILE_NAMES,
    MEDIA_TYPES,
    CalibrationForm,
    ConvertedCalibration,
    convert_calibration,
)
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/calibrations/{calibration_id}", tags=["calibrations"])
_OURS = {"application/json": {"schema": {"$ref": "#/components/schemas/CalibrationFile"}}}
Form = Annotated[
    CalibrationForm,
    Query(
        description="json: this program's own, another's file whole within; paper: eleven parameters a camera; opencv: "
        "YAML; dice: XML; matchid: caldat; vic3d: XML."
    ),
]


def _converted(service: Service, calibration_id: str, form: CalibrationForm) -> ConvertedCalibration:
    data = checked_bytes(complete(service, calibration_id) / "calibration.json")
    return convert_calibration(parse_calibration(data, name=f"Calibration {calibration_id}"), form, data)


@router.get(
    "/export",
    summary="A calibration in another program's form",
    response_class=Response,
    responses=errors(404, 409, 422)
    | {200: {"content": {media.split(";")[0]: _OURS.get(media, {}) for media in dict.fromkeys(MEDIA_TYPES.values())}}},
)
def export_calibration(service: ServiceDep, calibration_id: CalibrationId, format: Form) -> Response:  # noqa: A002
    """Return the file; a lens model that the form does not have is fitted, `export/report` states the residual.

    The headers X-Lens-Residual-Px and X-Epipolar-Residual-Px have the largest residuals.
    """
    made = _converted(service, calibration_id, format)
    name = f"{calibration_id}_{FILE_NAMES[format]}"
    lens = max(fit.max_px for fit in made.report.lens.values())
    epipolar = made.report.read_back.max_px
    headers = {
        "Content-Disposition": f'attachment; filename="{name}"',
        "X-Lens-Residual-Px": f"{lens:.3g}",
        "X-Epipolar-Residual-Px": "unknown" if epipolar is None else f"{epipolar:.3g}",
    }
    return Response(made.data, media_type=MEDIA_TYPES[format], headers=headers)


@router.get(
    "/export/report", summary="Losses of a calibration in another program's form", responses=errors(404, 409, 422)
)
def report_conversion(service: ServiceDep, calibration_id: CalibrationId, format: Form) -> ConversionReply:  # noqa: A002
    """Return the residual of each lens' fit, and the errors of the written file at points that both cameras see."""
    return ConversionReply.model_validate(asdict(_converted(service, calibration_id, format).report))
