"""Calibrations from images of the target that a client has: uploaded in pairs, or the views of an earlier calibration.

The views are stored and fitted as those that the rig takes; nothing moves, and no camera is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from stereorig.core.errors import CalibrationInputError, ImageError
from stereorig.core.names import CAMERAS
from stereorig.core.settings import Real, Whole
from stereorig.server.base.models import Ids, Label, Number, Request
from stereorig.server.cell.images import images as read_images
from stereorig.server.config.rig_file import CalibrationSection, TargetSection
from stereorig.server.formats.images import Decoded, read_image
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.calibration.sequence import close, fit
from stereorig.server.workflows.service import Service

MOST_PAIRS = 200
Read = Callable[[], dict[str, bytes]]
_Positive = Annotated[Real, Field(gt=0.0, le=1e9)]


class UploadedPlan(Request):
    """Description of uploaded views: the target, the cameras roughly, and how the views were taken."""

    target: TargetSection = Field(description="The target, as in a rig file.")
    phd_px: _Positive = Field(description="Focal length over the pixel's width, good to a few tens of percent.")
    moves: Literal["free", "cameras", "both_cameras", "target"] = Field(
        "free", description="Part that moved between the views: nothing known (`free`), or by `dz_mm`."
    )
    dz_mm: Annotated[list[Number], Field(max_length=MOST_PAIRS)] | None = Field(
        None, description="Travel at each pair, in the order of the files; null in free poses."
    )
    standoff_mm: _Positive | None = Field(None, description="Distance of cameras and target; null in free poses.")
    angle_deg: tuple[Real, Real] | None = Field(
        None, description="Angle of each camera's axis to the target's normal; null in free poses."
    )
    lens: Literal["auto", "paper", "opencv5", "opencv8", "opencv12", "opencv14"] = Field("auto", description="Lens.")
    localiser: Literal["profile", "paper"] = Field("profile", description="Localiser of a line grid's lines.")
    label: Label = Field("", description="Free text.")

    @model_validator(mode="after")
    def _positions_known(self) -> UploadedPlan:
        stated = [self.dz_mm, self.standoff_mm, self.angle_deg]
        if self.moves != "free" and None in stated:
            raise ValueError(f"moves = {self.moves!r} needs dz_mm, standoff_mm and angle_deg")
        if self.moves == "free" and self.dz_mm is not None:
            raise ValueError("free poses have no dz_mm")
        return self


class RefitRequest(Request):
    """Views to leave out of a calibration that is made anew from the others."""

    without: Annotated[list[Annotated[Whole, Field(ge=0, le=999)]], Field(min_length=1, max_length=MOST_PAIRS)] = Field(
        description="Numbers of the pairs to leave out.", examples=[[3, 7]]
    )
    label: Label = Field("", description="Free text.")


def begin_uploaded(service: Service, plan: UploadedPlan, pairs: Sequence[Read], request: RequestMark) -> Ids:
    """Check every image, store the views, and begin their fit; return the ids of calibration and job.

    Parameters
    ----------
    pairs
        Reads the files of a pair, by camera; called twice.

    Raises
    ------
    CalibrationInputError
        ``views_missing`` with no pair; ``positions_mismatch`` if there are not as many travels as pairs.
    ImageError
        A file is no image; ``image_size_mismatch`` where two of one camera differ in size.
    """
    if not pairs or (plan.dz_mm is not None and len(plan.dz_mm) != len(pairs)):
        travels = 0 if plan.dz_mm is None else len(plan.dz_mm)
        raise CalibrationInputError(
            f"There are {len(pairs)} pairs of images and {travels} travels.",
            code="positions_mismatch" if pairs else "views_missing",
            remedy="Send as many images of each camera, in the same order, and the travel of each pair if it is known.",
        )
    sizes = _sizes(service, pairs)
    usual = CalibrationSection.model_validate({"moves": "free"})
    cameras: dict[str, dict[str, Any]] = {
        cam: {
            "image_size_px": sizes[cam],
            "phd_px": plan.phd_px,
            "standoff_mm": plan.standoff_mm,
            "angle_deg": None if plan.angle_deg is None else plan.angle_deg[k],
            "aspect": 1.0,
        }
        for k, cam in enumerate(CAMERAS)
    }
    rig: dict[str, Any] = {
        "name": "uploaded images",
        "simulated": [],
        "target": plan.target.plain(),
        "moves": plan.moves,
        "lens": plan.lens,
        "axis_tilt_sigma_rad": usual.axis_tilt_sigma_rad,
        "aspect_sigma": None,
        "stage_scale_sigma": None,
        "stage_step_sigma_mm": 0.0,
        **cameras,
    }
    document = {
        "source": "images",
        "label": plan.label,
        "localiser": plan.localiser,
        "frames": 1,
        "moves": plan.moves,
        "rig": rig,
    }

    def views(calibration_id: str) -> Iterable[dict[str, Any]]:
        for index, read in enumerate(pairs):
            for cam, image in _decoded(service, read, index).items():
                stored = service.calibrations.put_view(calibration_id, index, cam, image.pixels)
                yield {
                    "index": index,
                    "camera": cam,
                    "role": "free" if plan.dz_mm is None else "fitted",
                    "dz_mm": None if plan.dz_mm is None else plan.dz_mm[index],
                    "frames": 1,
                    "full_scale": 2**image.bit_depth - 1,
                    **stored,
                }

    return _begin(service, document, views, request)


def begin_refit(service: Service, calibration_id: str, asked: RefitRequest, request: RequestMark) -> Ids:
    """Begin a calibration from another one's views without some of them; that one is kept.

    Raises
    ------
    CalibrationInputError
        ``views_missing`` if it has no such views, or none would be left.
    """
    made = service.calibrations.read(calibration_id)
    taken: list[dict[str, Any]] = [view.plain() for view in made.taken or []]
    known = {int(view["index"]) for view in taken}
    strange = sorted(set(asked.without) - known)
    left = [view for view in taken if view["index"] not in asked.without]
    if strange or not left:
        raise CalibrationInputError(
            f"Calibration {calibration_id} has {len(known)} pairs of views; "
            + (f"number {strange[0]} is none of them." if strange else "all were left out."),
            code="views_missing",
            remedy="Leave out views of GET /calibrations/{id}/views, and keep at least three.",
        )
    plan: dict[str, Any] = made.plan.plain()
    dropped = {*plan.get("without", []), *asked.without}
    label = asked.label or f"{made.plan.label or calibration_id} without {', '.join(str(n) for n in sorted(dropped))}"
    kept = {name: plan[name] for name in plan if name not in ("id", "created_utc", "job_id", "request", "check")}
    document = {**kept, "label": label[:300], "refitted_from": calibration_id, "without": sorted(dropped)}
    if "held_out_mm" in plan:  # a position of which no view is left would be refused
        held = {view.get("dz_commanded_mm") for view in left if view["role"] == "held_out"}
        document["held_out_mm"] = [mm for mm in plan["held_out_mm"] if mm in held]

    def views(new_id: str) -> Iterable[dict[str, Any]]:
        for view in left:
            image = read_image(service.calibrations.view_file(calibration_id, int(view["index"]), str(view["camera"])))
            yield {**view, **service.calibrations.put_view(new_id, int(view["index"]), str(view["camera"]), image)}

    return _begin(service, document, views, request)


def _begin(
    service: Service, document: dict[str, Any], views: Callable[[str], Iterable[dict[str, Any]]], request: RequestMark
) -> Ids:
    service.require_room()

    def prepare(job: Job) -> Ids:
        plan = {**document, **request.document(), "job_id": job.id}
        calibration_id = service.calibrations.create(plan, document["rig"]["target"])
        service.calibrations.put_views_done(calibration_id, list(views(calibration_id)))
        return {"calibration_id": calibration_id}

    job = service.jobs.submit(
        "calibration",
        "a calibration from images",
        {},
        [Phase("compute", lambda job: fit(service, job, str(job.subject["calibration_id"])))],
        prepare=prepare,
        request=request,
        on_end=lambda job, state: close(service, job, str(job.subject["calibration_id"]), state),
    )
    return {"calibration_id": str(job.subject["calibration_id"]), "job_id": job.id}


def _decoded(service: Service, read: Read, index: int) -> dict[str, Decoded]:
    found = read_images(service.cell, {f"image {index + 1} of {cam}": data for cam, data in read().items()})
    return dict(zip(CAMERAS, found.values(), strict=True))


def _sizes(service: Service, pairs: Sequence[Read]) -> dict[str, list[int]]:
    """Return each camera's width and height, the same in all its images."""
    sizes: dict[str, list[int]] = {}
    for index, read in enumerate(pairs):
        for cam, image in _decoded(service, read, index).items():
            size = [*reversed(image.pixels.shape)]
            if sizes.setdefault(cam, size) != size:
                raise ImageError(
                    f"Image {index + 1} of {cam} has {size[0]} x {size[1]} px, the first {sizes[cam][0]} x "
                    f"{sizes[cam][1]}.",
                    code="image_size_mismatch",
                    remedy="Give images of one camera at one setting.",
                )
    return sizes
