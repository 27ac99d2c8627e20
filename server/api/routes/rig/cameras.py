"""The rig and its cameras."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Mapping
from dataclasses import asdict
from typing import Annotated, Literal

import anyio
import cv2
import numpy as np
from anyio import CapacityLimiter
from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response, StreamingResponse

from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS
from stereorig.drivers.cameras.protocol import CameraSettings, Frame
from stereorig.server.api.models import (
    Accepted,
    CameraReply,
    CameraSet,
    CamerasReply,
    CameraStats,
    ExposureFound,
    ExposureRequest,
    RigReply,
    SceneReply,
    SceneRequest,
    SettingsPatch,
)
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import Camera, KeyHeader, ServiceDep, Wait, get_service, job_reply, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.formats.images import encode_tiff
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.results.images.quality import image_quality
from stereorig.server.workflows.calibration.guided import GUIDED_PURPOSE
from stereorig.server.workflows.exposure import set_exposure
from stereorig.server.workflows.service import Service

router = APIRouter(tags=["rig"])
_BOUNDARY = "frame"


@router.get("/rig", summary="The rig: cameras, stage, target, who holds it", response_model_exclude_unset=True)
def get_rig(service: ServiceDep) -> RigReply:
    """Return the state of the rig, its target, cameras and stage."""
    return service.rig.describe()


@router.post(
    "/rig:reconnect", summary="Open cameras and stage again", status_code=202, responses=errors(409, 422, 503, 507)
)
async def reconnect(request: Request, service: ServiceDep, wait: Wait = 0.0, key: KeyHeader = None) -> Accepted:
    """Close and open every device; settings are pushed and read back."""
    job_id = await run_in_threadpool(_start_reconnection, service, key)
    return Accepted.model_validate(await job_reply(request, service, job_id, wait_s=wait))


def _start_reconnection(service: Service, key: str | None) -> str:

    def run(job: Job) -> Mapping[str, object]:
        job.progress("reconnecting", 0, 1)
        service.rig.reconnect()
        return {"rig": service.config.rig.name}

    def make() -> Ids:
        job = service.jobs.submit(
            "reconnect", "a reconnection of the rig", {}, [Phase("hardware", run)], request=request
        )
        return {"job_id": job.id}

    request = mark("reconnect", key, None)
    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return str(made["job_id"])


@router.put(
    "/sim/scene",
    summary="Choose the scene of a simulated rig",
    response_model_exclude_unset=True,
    responses=errors(409, 422, 503),
)
def put_scene(service: ServiceDep, body: SceneRequest) -> SceneReply:
    """Put the grid, a plate, a panel ... before the cameras; on simulated rigs, during a guided acquisition too."""
    # a hand that holds the target before the cameras is no other client of them
    holder = service.hardware.holder
    guided = holder is not None and holder.purpose == GUIDED_PURPOSE
    with contextlib.nullcontext() if guided else service.hardware.hold("a change of the scene"):
        scene = service.rig.set_scene(body.scene, load=body.load, params=body.params)
    service.hub.publish("scene", scene.model_dump())
    return scene


@router.get("/cameras", summary="Both cameras", response_model_exclude_unset=True)
def get_cameras(service: ServiceDep) -> CamerasReply:
    """Return nominal data, the devices' own descriptions and their settings."""
    return CamerasReply(cameras=[service.rig.describe_camera(cam) for cam in CAMERAS])


@router.get("/cameras/{cam:plain_id}", summary="One camera", response_model_exclude_unset=True, responses=errors(422))
def get_camera(service: ServiceDep, cam: Camera, response: Response) -> CameraReply:
    """Return nominal data, the device's own description and its settings."""
    return tagged(response, service.rig.describe_camera(cam))


@router.patch("/cameras/{cam:plain_id}", summary="Change a camera's settings", responses=errors(409, 412, 422, 503))
def patch_camera(
    service: ServiceDep, cam: Camera, body: SettingsPatch, response: Response, if_match: IfMatch = None
) -> CameraSet:
    """Set the given values; the answer holds every setting as read back. If-Match refuses if others changed them."""
    with service.hardware.hold(f"new settings of {cam}"):
        require_match(if_match, etag_of(service.rig.describe_camera(cam)), f"the settings of {cam}", required=False)
        taken = service.rig.configure(cam, CameraSettings(**body.model_dump()))
        response.headers["ETag"] = etag_of(service.rig.describe_camera(cam))
    return CameraSet.model_validate({"name": cam, "settings": asdict(taken)})


@router.post(
    "/cameras/{cam}:expose", summary="Search for a camera's exposure, and set it", responses=errors(409, 422, 503)
)
def expose(service: ServiceDep, cam: Camera, body: ExposureRequest | None = None) -> ExposureFound:
    """Bring the picture's brightest parts to a level, without saturation; the old exposure is kept if none does."""
    wanted = body or ExposureRequest()
    with service.hardware.hold(f"the search for {cam}'s exposure"):
        taken, found = set_exposure(service, cam, wanted.level, wanted.shortest_ms, wanted.longest_ms)
    return ExposureFound.model_validate(
        {
            "name": cam,
            "settings": asdict(taken),
            "level": found.brightness.level,
            "saturated_share": found.brightness.saturated_share,
            "pictures": found.pictures,
        }
    )


@router.get(
    "/cameras/{cam}/frame",
    summary="A frame, as PNG or TIFF",
    response_class=Response,
    responses=errors(409, 422, 503) | {200: {"content": {"image/png": {}, "image/tiff": {}}}},
)
def get_frame(
    service: ServiceDep,
    cam: Camera,
    format: Annotated[Literal["png", "tiff"], Query(description="File format.")] = "png",  # noqa: A002
) -> Response:
    """Return the newest frame, with every grey level as the camera gave it."""
    frame = service.rig.pair.live(cam, max_age_s=0.1)
    headers = {
        "X-Frame-Sequence": str(frame.sequence),
        "X-Bit-Depth": str(frame.bit_depth),
        "Cache-Control": "no-store",
    }
    if format == "tiff":
        return Response(encode_tiff(frame.pixels), media_type="image/tiff", headers=headers)
    _, data = cv2.imencode(".png", frame.pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return Response(data.tobytes(), media_type="image/png", headers=headers)


@router.get(
    "/cameras/{cam}/stats",
    summary="Counters of a camera's frames, and the newest one's quality",
    responses=errors(409, 422, 503),
)
def get_stats(service: ServiceDep, cam: Camera) -> CameraStats:
    """Return counters, mean grey level, saturation, texture, focus and histogram."""
    frame = service.rig.pair.live(cam, max_age_s=0.2)
    shift = max(frame.bit_depth - 8, 0)
    histogram = np.bincount((frame.pixels >> shift).ravel().astype(np.uint8), minlength=256)
    return CameraStats.model_validate(
        {
            "name": cam,
            "frames": service.rig.pair.units[cam].counters(),
            "driver": service.rig.pair.units[cam].statistics(),
            "pairs": service.rig.pair.account(),
            "sequence": frame.sequence,
            "quality": image_quality(frame.pixels, frame.bit_depth).as_dict(),
            "histogram": histogram.tolist(),
        }
    )


def _jpeg(frame: Frame) -> bytes:
    pixels = (frame.pixels >> max(frame.bit_depth - 8, 0)).astype(np.uint8)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return data.tobytes()


@router.get(
    "/cameras/{cam}/stream.mjpg",
    summary="Live view",
    response_class=StreamingResponse,
    responses=errors(409, 422, 503) | {200: {"content": {"multipart/x-mixed-replace": {}}}},
)
async def get_stream(
    request: Request,
    cam: Camera,
    rate_hz: Annotated[float, Query(gt=0.0, le=30.0, description="Frames a second at most.")] = 10.0,
) -> StreamingResponse:
    """Stream JPEG frames for an `<img>`; a slow reader gets fewer of them, and recording comes first."""
    service = get_service(request)
    pair = service.rig.pair
    service.streams.check("live_view")
    # live views have few threads of their own, and can never take threads of other requests
    limiter: CapacityLimiter = request.app.state.view_limiter

    def newer(last: int | None) -> tuple[int, bytes | None]:
        frame = pair.live(cam, max_age_s=0.9 / rate_hz, after=last)
        return frame.sequence, None if frame.sequence == last else _jpeg(frame)

    async def parts() -> AsyncIterator[bytes]:
        last: int | None = None
        due = anyio.current_time()
        with service.streams.counted("live_view"):
            while not service.closing:
                try:
                    sequence, data = await anyio.to_thread.run_sync(
                        newer, last, limiter=limiter, abandon_on_cancel=True
                    )
                except StereorigError as error:
                    if error.code == "camera_busy":  # a capture is running, and there is no older frame to show
                        continue
                    return  # the stream ends; GET /rig gives the reason
                # by a timetable, since pauses are each a little too long; before the first frame the wait is a
                # quarter of the period, since a whole one would halve the rate
                due += (0.25 if data is None else 1.0) / rate_hz
                if data is not None:
                    last = sequence
                    head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    yield head.encode() + data + b"\r\n"
                due = max(due, anyio.current_time())  # missed frames are not made up for
                await anyio.sleep_until(due)

    return StreamingResponse(
        parts(), media_type=f"multipart/x-mixed-replace; boundary={_BOUNDARY}", headers={"Cache-Control": "no-store"}
    )
