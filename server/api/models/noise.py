"""Noise measurements, as they travel."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, with_config
from typing_extensions import TypedDict

from stereorig.core.settings import Whole
from stereorig.server.api.models.jobs import Accepted, JobProblem
from stereorig.server.base.models import Label, Listing, Reply, Request
from stereorig.server.documents.made import MadeState


class NoiseRequest(Request):
    """Measurement of the cameras' noise."""

    frames: Annotated[Whole, Field(ge=2, le=200)] = Field(16, description="Pairs of frames; the scene must be at rest.")
    even: bool = Field(
        False,
        description="The cameras see an even field (a diffuser, far out of focus): a map of each sensor's fixed "
        "pattern and defective pixels is measured too, and taken off images that are measured with this `noise_id`.",
    )
    label: Label = Field("", description="Free text.")


class NoiseAccepted(Accepted):
    """A noise measurement was begun."""

    noise_id: str = Field(description="Id of the noise measurement.", examples=["n000001-5b1c22"])


class SensorReply(Reply):
    """The map of a sensor in two numbers; noise.json has all of it."""

    pattern_sd_grey: float = Field(description="Standard deviation of its fixed pattern, grey levels.")
    defective_pixels: int = Field(description="Number of its defective pixels.")


class NoiseModelReply(Reply):
    """One camera's model: variance = c0 + c1 g + c2 g^2 at grey level g."""

    coefficients: list[float] = Field(description="c0, c1, c2, in grey levels squared, grey levels, 1.")
    coefficients_sd: list[float] = Field(description="Their standard deviations.")
    range_grey: list[float | None] = Field(description="Grey levels between which it holds; null: no end.")
    frames: int = Field(description="Frames it was measured from.")
    misfit: float = Field(description="Scatter of the bins about it, in their own sd; 1 is chance.")
    drift: float = Field(description="Largest relative change of brightness between frames; taken out.")
    shift_px: float = Field(description="Largest motion of the image between frames; taken out.")
    sensor: SensorReply | None = Field(None, description="Its fixed pattern; null: not measured.")


class NoiseFile(Reply):
    """noise.json, which `stereorig measure --noise` reads."""

    cam1: NoiseModelReply | None = Field(None, description="Camera 1's model.")
    cam2: NoiseModelReply | None = Field(None, description="Camera 2's model.")


@with_config(extra="allow")
class NoisePlanReply(TypedDict, total=False):
    """Plan of a noise measurement."""

    created_utc: Annotated[str, Field(description="Time at which it was begun.")]
    label: Annotated[str, Field(description="Free text.")]
    frames: Annotated[int, Field(description="Frames taken.")]
    rig: Annotated[str, Field(description="Name of the rig.")]
    job_id: Annotated[str | None, Field(description="The job that takes or took them.")]


class NoiseReply(Reply):
    """A noise measurement."""

    id: str = Field(description="Id.")
    state: MadeState = Field(description="State of the measurement.")
    plan: NoisePlanReply = Field(description="Plan.")
    problem: JobProblem | None = Field(None, description="Problem that left no models.")
    cam1: NoiseModelReply | None = Field(None, description="Camera 1's model.")
    cam2: NoiseModelReply | None = Field(None, description="Camera 2's model.")


class NoiseList(Listing):
    """Noise measurements, oldest first."""

    noise: list[NoiseReply] = Field(description="Noise measurements, oldest first.")
