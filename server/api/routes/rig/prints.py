"""Pages for a printer: calibration target, speckle; and a print's measured scale."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response
from pydantic import Field

from stereorig.core.boards.board import BoardTarget
from stereorig.core.target import GridTarget
from stereorig.server.api.protocol.dependencies import ServiceDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Reply, Request
from stereorig.server.config.rig_file import TargetSection
from stereorig.server.formats.calibrations.target_toml import target_of, toml_of
from stereorig.server.formats.prints.drawing import PrintedPage
from stereorig.server.formats.prints.measured import measured_print
from stereorig.server.formats.prints.page import PAPER_HELP
from stereorig.server.formats.prints.speckle import speckle_mm, speckle_page
from stereorig.server.formats.prints.targets import target_drawing, title_of, unmeasured_text

router = APIRouter(prefix="/prints", tags=["rig"])

PageForm = Literal["pdf", "svg"]
_MEDIA = {"pdf": "application/pdf", "svg": "image/svg+xml", "toml": "application/toml"}
_PAGES = errors(422) | {200: {"content": {name: {} for name in _MEDIA.values()}}}
_Millimetres = Annotated[float, Field(gt=0.0, le=1e4)]
Paper = Annotated[str, Field(max_length=20, description=f"{PAPER_HELP}.")]
Margin = Annotated[float, Field(ge=0.0, le=40.0, description="Rim on which the printer does not print.")]


class TargetPrint(Request):
    """A page with a calibration target."""

    target: TargetSection | None = Field(None, description="The target, as in a rig file; null: the rig's.")
    marks: bool = Field(False, description="Dots in rows and columns: three rings mark the axes.")
    paper: Paper = "A4"
    margin_mm: Margin = 10.0
    form: Literal["pdf", "svg", "toml"] = Field("pdf", description="`toml`: the target file of the print.")


class MeasuredRequest(Request):
    """Measured rulers of a printed target: one, or the one across and the one down."""

    target_file: Annotated[str, Field(max_length=100_000)] = Field(description="Text of the print's target file.")
    printed_mm: Annotated[list[_Millimetres], Field(min_length=1, max_length=2)] = Field(
        description="Lengths by the rulers' numbers.", examples=[[150.0, 250.0]]
    )
    measured_mm: Annotated[list[_Millimetres], Field(min_length=1, max_length=2)] = Field(
        description="The same lengths as measured.", examples=[[149.91, 249.8]]
    )
    u_mm: _Millimetres = Field(description="Standard uncertainty of a measured length.", examples=[0.05])


class MeasuredReply(Reply):
    """A print's measured scale."""

    title: str = Field(description="The target in a few words.")
    scale: float = Field(description="Measured over printed length.", examples=[0.9993])
    sigma: float = Field(description="Its standard uncertainty, which the calibration carries into every length.")
    stretch: float | None = Field(description="Half the directions' difference of scale; null: one was measured.")
    target_file: str = Field(description="New text of the target file, in measured millimetres.")


@router.post(
    "/target", summary="A calibration target as a page for a printer", response_class=Response, responses=_PAGES
)
def print_target(service: ServiceDep, body: TargetPrint | None = None) -> Response:
    """Draw a target in true millimetres with rulers, as PDF or SVG; or give the target file of the print."""
    body = body or TargetPrint.model_validate({})
    target = _target(body.target or service.config.target)
    drawing = target_drawing(target, paper=body.paper, margin_mm=body.margin_mm, marks=body.marks)
    if body.form == "toml":
        return _file(unmeasured_text(target).encode(), "target", "toml")
    return _page(drawing, "target", body.form)


@router.get("/speckle", summary="Speckle as a page for a printer", response_class=Response, responses=_PAGES)
def print_speckle(
    service: ServiceDep,
    diameter_mm: Annotated[
        float | None, Query(gt=0.0, le=100.0, description="Diameter of a disc; left out: by `diameter_px`.")
    ] = None,
    diameter_px: Annotated[float, Query(description="The same in the rig's images, 3 to 5.")] = 4.0,
    share: Annotated[float, Query(description="Black share of the area, 0.2 to 0.7.")] = 0.5,
    seed: Annotated[int, Query(ge=0, le=2**32, description="Names the pattern.")] = 1,
    paper: Annotated[str, Query(max_length=20, description=f"{PAPER_HELP}.")] = "A4",
    margin_mm: Annotated[float, Query(ge=0.0, le=40.0, description="Unprinted rim.")] = 10.0,
    form: Annotated[PageForm, Query(description="File format.")] = "pdf",
) -> Response:
    """Draw discs of one diameter at random places, with rulers; the same seed is the same pattern."""
    diameter = speckle_mm(diameter_mm, diameter_px, service.config.mm_per_px)
    return _page(speckle_page(diameter, share=share, seed=seed, paper=paper, margin_mm=margin_mm), "speckle", form)


@router.post("/measured", summary="Bring a print's measured rulers into its target file", responses=errors(422))
def measure_print(body: MeasuredRequest) -> MeasuredReply:
    """Scale the description to measured millimetres, with the scale's uncertainty; nothing is stored."""
    content = toml_of(body.target_file.encode(), "target_file", kind="target description")
    found = measured_print(content, "target_file", body.printed_mm, body.measured_mm, body.u_mm)
    return MeasuredReply(
        title=title_of(found.target),
        scale=found.scale,
        sigma=found.sigma,
        stretch=found.stretch,
        target_file=found.text,
    )


def _target(section: TargetSection) -> GridTarget | BoardTarget:
    return target_of(section.plain(), "target")


def _page(drawing: PrintedPage, name: str, form: PageForm) -> Response:
    return _file(drawing.data(form), name, form)


def _file(data: bytes, name: str, form: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}.{form}"'}
    return Response(data, media_type=_MEDIA[form], headers=headers)
