"""Guided acquisitions, as they travel."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from stereorig.core.settings import Real, Whole
from stereorig.server.api.models.jobs import JobProblem
from stereorig.server.base.models import Label, Reply, Request, Switch


class GuideRequest(Request):
    """A guided acquisition of free poses."""

    quantity: Literal["z", "shape"] = Field(
        "z", description="Uncertainty that the goal is about: rms of Z over the specimen's volume, or of X, Y and Z."
    )
    goal_um: Annotated[Real, Field(gt=0.0, le=1e6)] | None = Field(
        None,
        description="The acquisition ends by itself below this many micrometres; null: when it is finished.",
        examples=[1.5],
    )
    frames: Annotated[Whole, Field(ge=1, le=64)] = Field(
        1, description="Frames averaged for a view; more than one only where the target rests on something."
    )
    automatic: Switch = Field(
        True, description="Take a view when the target is at rest in a pose that is new; false: on request alone."
    )
    rest_px: Annotated[Real, Field(gt=0.0, le=100.0)] = Field(
        1.0, description="Largest move of the points between two live pairs that counts as rest."
    )
    localiser: Literal["profile", "paper"] | None = Field(None, description="Grid line localiser.")
    label: Label = Field("", description="Free text.")


class SeenTarget(Reply):
    """The target in one camera's live image."""

    found: int = Field(description="Number of points found.", examples=[54])
    points_px: list[list[float]] = Field(description="Column and row of each, found coarsely.")
    outline_px: list[list[float]] = Field(description="Their outline, to draw.")
    problem: JobProblem | None = Field(description="Why it was not found; null: it was.")


class LiveLook(Reply):
    """Findings of the newest live pair."""

    cameras: dict[str, SeenTarget] = Field(description="By camera.")
    seen: bool = Field(description="True if both cameras show the target.")
    still: bool = Field(description="True if it has not moved since the pair before.")
    moved_px: float | None = Field(description="Median move of its points since then; null: not known.")
    new: bool = Field(description="True if its pose differs enough from every view taken.")
    like_view: int | None = Field(description="The view that it is most like; null: none.")
    difference: float | None = Field(description="Difference from that view; 1 and more is new.")


class GuideUncertainty(Reply):
    """Uncertainty over the specimen's volume, the rigid motion of the whole taken out."""

    z_um: float = Field(description="Rms of Z.", examples=[1.4])
    shape_um: float = Field(description="Rms of X, Y and Z.", examples=[1.1])


class GuideProposal(Reply):
    """The next most useful view."""

    text: str = Field(
        description="The pose in words.", examples=["Hold it nearer, tilted to the left by about 38 degrees"]
    )
    distance: Literal["nearer", "as far", "farther"] = Field(description="Against the specimen.")
    tilt: Literal["none", "left", "right", "up", "down"] = Field(description="Where its face turns in the images.")
    tilt_deg: float = Field(description="By how much.")
    part: str = Field(description="Part of the images.", examples=["in the upper left"])
    pose: list[float] = Field(
        description="Rotation vector in degrees and place in mm of the target, in the frame of the first view."
    )
    outlines_px: dict[str, list[list[float]]] = Field(description="By camera, the corners of its points, to draw.")
    predicted: GuideUncertainty | None = Field(description="With this view added; null: not determined.")


class GuideCoverage(Reply):
    """Cover of the image and of poses by the views taken."""

    cells: dict[str, list[list[int]]] = Field(description="By camera, points seen in each of 6 rows of 8 cells.")
    share: dict[str, float] = Field(description="By camera, share of the cells with points.")
    depth_edges: list[float] = Field(description="Limits of the classes of distance, over the specimen's distance.")
    depths: list[int] = Field(description="Views in each class, nearest first; the outermost are open.")
    tilts: dict[str, int] = Field(description="Views by the direction that the target's face turns to.")


class LeftOut(Reply):
    """A view that does not count."""

    view: int = Field(description="Its number.")
    camera: str = Field(description="Whose image.")
    reason: str = Field(description="Why.")


class GuidanceReply(Reply):
    """Findings from the views taken."""

    taken: int = Field(description="Views on disk.")
    used: int = Field(description="Of these, with the target found by both cameras and fitting the others.")
    left_out: list[LeftOut] = Field(description="The others.")
    coverage: GuideCoverage = Field(description="Cover of images and poses.")
    adjusted: bool = Field(description="False while they are too few: uncertainties then come from nominal lenses.")
    reason: str = Field(description="Why there is no adjustment.")
    lens: str = Field(description="Lens model so far.", examples=["paper"])
    uncertainty: GuideUncertainty | None = Field(description="By the views taken; null: not determined.")
    reached: bool = Field(description="True once the goal is met.")
    text: str = Field(
        description="Next thing to do, in a sentence.",
        examples=["Hold it nearer, tilted to the left: the uncertainty of Z at your specimen goes from 2.1 to 1.4 um."],
    )
    proposal: GuideProposal | None = Field(description="The next view; null: none would be seen whole.")


class GuideReply(Reply):
    """A guided acquisition, now."""

    calibration_id: str = Field(description="Its calibration.")
    job_id: str | None = Field(description="Its job: DELETE it to end without a fit; the views are kept.")
    state: Literal["acquiring", "fitting", "unfinished", "cancelled", "failed", "complete"] = Field(
        description="State."
    )
    quantity: Literal["z", "shape"] = Field(description="Uncertainty that the goal is about.")
    goal_um: float | None = Field(description="The goal; null: none.")
    automatic: bool = Field(description="True if views are taken by themselves.")
    rate_hz: float | None = Field(description="Live pairs looked at in a second; null: none yet.")
    looks: int = Field(description="Live pairs looked at.")
    live: LiveLook | None = Field(description="The newest one; null if the acquisition has ended or just begins.")
    guidance: GuidanceReply | None = Field(description="Findings from the views; null until they are known first.")
