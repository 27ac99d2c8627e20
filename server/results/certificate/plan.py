"""The plan of a certificate: the known values of each step; the same for the command line and the API."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Self

from pydantic import ConfigDict, Field, StringConstraints, ValidationError, model_validator

from stereorig.core.certify.comparison import Above, CertificateLimits, NotNegative
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.settings import Pixel, Whole, disagreement
from stereorig.server.base.models import Label, Notes, Number, Request, StepNumber, not_both, one_of
from stereorig.server.config.rig_file import TargetSection
from stereorig.server.wording import problems_in

Position = tuple[Pixel, Pixel]
_MOST = 1000


class StatedTarget(TargetSection):
    """A target of known size; the fields that its kind needs are checked when it is used."""

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> Self:
        # no schema can state which fields go together: such a target is refused as a value, not as a malformed request
        return self


class Translation(Request):
    """A step in which the specimen was moved by a known way."""

    model_config = ConfigDict(json_schema_extra=one_of("translation_mm", "distance_mm"))

    n: StepNumber = Field(description="Number of the step.")
    translation_mm: tuple[Number, Number, Number] | None = Field(
        None, description="The way since the reference, along X, Y, Z of the system frame.", examples=[[0.0, 0.0, 1.0]]
    )
    distance_mm: Above | None = Field(
        None, description="The way's length, where its direction is not known; instead of translation_mm."
    )
    u_mm: NotNegative = Field(0.0, description="Standard uncertainty of the way, of each of its components.")

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if (self.translation_mm is None) == (self.distance_mm is None):
            raise ValueError("give translation_mm or distance_mm")
        return self


class Rotation(Request):
    """A step in which the specimen was turned."""

    n: StepNumber = Field(description="Number of the step.")
    angle_deg: Annotated[Number, Field(gt=0.0, le=180.0)] | None = Field(
        None, description="The angle; null: not known, then shape and strain alone are compared."
    )
    u_deg: NotNegative = Field(0.0, description="Standard uncertainty of the angle.")


class Images(Request):
    """Files of a pair of images, from the plan's folder; not over the API."""

    cam1: str = Field(description="Camera 1's image.")
    cam2: str = Field(description="Camera 2's image.")


class KnownLength(Request):
    """A known length at one place of the volume: two positions on the specimen, or a target of known size."""

    model_config = ConfigDict(json_schema_extra=not_both("a_px", "target"))

    name: Annotated[Label, StringConstraints(min_length=1)] = Field(
        description="Artefact and place.", examples=["scale bar, upper left"]
    )
    artefact: Label = Field("", description="Lengths of one artefact share its uncertainty.")
    n: StepNumber | None = Field(None, description="Step that shows it.")
    images: Images | None = Field(None, description="Files that show a target, instead of a step.")
    a_px: Position | None = Field(None, description="One end, in camera 1's reference image.", examples=[[60.0, 80.0]])
    b_px: Position | None = Field(None, description="The other end.")
    length_mm: Above | None = Field(None, description="The known length between both ends.", examples=[25.0])
    target: StatedTarget | None = Field(
        None, description="A target of known size, as in a rig file; another than the one that was calibrated with."
    )
    u_mm: NotNegative = Field(
        0.0, description="Standard uncertainty of the length; for a target's, besides its own tolerances."
    )

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        ends = [v is not None for v in (self.a_px, self.b_px, self.length_mm)]
        if self.target is None and not (all(ends) and self.n is not None and self.images is None):
            raise disagreement("give n, a_px, b_px and length_mm, or a target")
        if self.target is not None and (any(ends) or (self.n is None) == (self.images is None)):
            raise disagreement("give a target with n or images, and no a_px, b_px, length_mm")
        return self


class ReferenceReading(Request):
    """Reading of the reference extensometer in a step."""

    n: StepNumber = Field(description="Number of the step.")
    elongation_mm: Number = Field(description="Elongation since the reference step.")


class ReferenceExtensometer(Request):
    """A reference extensometer to compare with a virtual one."""

    model_config = ConfigDict(json_schema_extra=not_both("readings", "channel"))

    a_px: Position = Field(description="One end of the virtual extensometer, in camera 1's reference image.")
    b_px: Position = Field(description="The other end.")
    readings: list[ReferenceReading] = Field(default_factory=list, description="Its readings.", max_length=_MOST)
    channel: Annotated[Label, StringConstraints(min_length=1)] | None = Field(
        None,
        description="Channel of the steps that holds its elongation, instead of readings; its name ends in the unit, "
        "`_mm` or `_um`.",
        examples=["extensometer_mm"],
    )
    u_mm: NotNegative = Field(0.0, description="Standard uncertainty of its elongation.")
    gauge_length_mm: Above | None = Field(None, description="Its gauge length.")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if bool(self.readings) == (self.channel is not None):
            raise disagreement("give readings or a channel")
        return self


class CertificatePlan(Request):
    """The known values of a verification procedure's steps, and the requirements on the system."""

    title: Label = Field("", description="Object of the certificate.", examples=["Bench 2, 50 mm lenses"])
    laboratory: Label = Field("", description="Laboratory, address.")
    operator: Label = Field("", description="Person who took the procedure.")
    notes: Notes = Field("", description="Standards used with their own certificates, temperature, anything else.")
    static_steps: list[StepNumber] | None = Field(
        None,
        description="Steps in which nothing moved since the reference. Left out: those whose label begins with "
        "`static`.",
        max_length=_MOST,
    )
    translations: list[Translation] = Field(default_factory=list, description="Known ways.", max_length=_MOST)
    stage_scale_u: Annotated[NotNegative, Field(le=1.0)] = Field(
        0.0, description="Relative standard uncertainty of the scale that all known ways share.", examples=[2e-5]
    )
    rotations: list[Rotation] = Field(default_factory=list, description="Rotations.", max_length=_MOST)
    lengths: list[KnownLength] = Field(default_factory=list, description="Known lengths.", max_length=_MOST)
    extensometer: ReferenceExtensometer | None = Field(None, description="A reference extensometer.")
    limits: CertificateLimits = Field(
        default_factory=lambda: CertificateLimits.model_validate({}), description="Requirements on the system."
    )
    valid_days: Annotated[Whole, Field(ge=1, le=3650)] = Field(
        365, description="Days for which the certificate holds; it ends before with the calibration."
    )

    @model_validator(mode="after")
    def _each_step_once(self) -> Self:
        moved = [one.n for one in self.translations] + [one.n for one in self.rotations]
        every = [*moved, *(self.static_steps or ())]
        twice = sorted({n for n in every if every.count(n) > 1})
        if twice:
            raise disagreement(f"step {twice[0]} is named twice: a step is static, a translation or a rotation")
        return self


def plan_in(document: object, *, name: str) -> CertificatePlan:
    """Read a plan.

    Raises
    ------
    InputError
        ``certificate_plan_invalid``: one line that names the first wrong entry.
    """
    try:
        return CertificatePlan.model_validate(document)
    except ValidationError as error:
        first = problems_in(error)[0]
        where = f"{first.field}: " if first.field else ""
        raise InputError(
            f"{name}: {where}{first.problem}.",
            code="certificate_plan_invalid",
            remedy="Correct it; docs/how_to/evidence/certify.md describes the plan.",
        ) from error


def load_plan(path: Path) -> CertificatePlan:
    """Read a plan's file, JSON.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``.
    InputError
        ``certificate_plan_invalid``.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileFormatError(f"{path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path} cannot be read as JSON: {error}.") from error
    return plan_in(document, name=str(path))
