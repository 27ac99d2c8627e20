"""The guide: state of the acquisition after some views, the goal, and the next view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.held_out import MIN_FRAMES
from stereorig.core.calibration.guide.coverage import ViewCoverage, coverage_of
from stereorig.core.calibration.guide.estimate import Estimate, estimate
from stereorig.core.calibration.guide.information import Spread, information
from stereorig.core.calibration.guide.proposals import Proposal, propose
from stereorig.core.calibration.inputs import AnyTarget, CalibrationOptions, CalibrationView, NominalValues
from stereorig.core.calibration.uncertainty import volume_points_mm
from stereorig.core.errors import CalibrationError

Quantity = Literal["z", "shape"]


@dataclass(frozen=True, kw_only=True, eq=False)
class GuideOptions:
    """Goal of an acquisition, and the volume that it holds for.

    Attributes
    ----------
    quantity
        ``z``: rms uncertainty of Z over the specimen's volume; ``shape``: of X, Y and Z. The rigid motion common to
        all points is taken out of both: a shape or a displacement does not feel it.
    goal_um
        The acquisition ends once the quantity is below; None: it ends when the user stops it.
    specimen_mm
        (p, 3) points of the specimen's volume in the frame of the first view; without them the volume of the target in
        the first view, as for a calibration's own figures.
    """

    quantity: Quantity = "z"
    goal_um: float | None = None
    specimen_mm: Float | None = None


@dataclass(frozen=True, eq=False)
class Guidance:
    """State of an acquisition.

    Attributes
    ----------
    estimate
        Cameras and poses.
    views
        Number of poses that both cameras saw and that fit.
    coverage
        Parts of the images, depths and tilts that they cover.
    spread
        Uncertainty from the views taken; None if they do not determine it.
    proposal
        The next view; None if both cameras would see the target whole in no pose.
    text
        The same in a sentence.
    reached
        True if the goal is met.
    """

    estimate: Estimate
    views: int
    coverage: ViewCoverage
    spread: Spread | None
    proposal: Proposal | None
    text: str
    reached: bool


def guide(
    views: Sequence[CalibrationView],
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    calibration: CalibrationOptions | None = None,
    options: GuideOptions | None = None,
    *,
    previous: Estimate | None = None,
) -> Guidance:
    """Return the state of an acquisition of free poses, and the view that it should take next.

    Parameters
    ----------
    views
        Views taken so far, none or more, of free poses. The first pose is the system frame: the target held where the
        specimen will be.
    target, nominals, calibration
        As :func:`stereorig.core.calibration.calibrate` will get them.
    options
        The goal.
    previous
        The estimate of an earlier guidance with fewer views; a start that spares the search.
    """
    calibration, options = calibration or CalibrationOptions(moves="free"), options or GuideOptions()
    found = estimate(views, target, nominals, calibration, previous)
    sizes = nominals[0].image_size_px, nominals[1].image_size_px
    volume = volume_points_mm(target) if options.specimen_mm is None else options.specimen_mm
    info = information(found, volume)
    spread: Spread | None = None
    if found.problem.system_frame is not None:
        try:
            spread = info.spread()
        except (CalibrationError, np.linalg.LinAlgError):
            spread = None
    count = len({r.frame for r in found.rows if r.camera == 0} & {r.frame for r in found.rows if r.camera == 1})
    now = None if spread is None else _of(spread, options.quantity)
    reached = (
        options.goal_um is not None
        and found.adjusted
        and count >= MIN_FRAMES  # so that some can be left out to check the others
        and now is not None
        and now <= options.goal_um
    )
    proposal = propose(info, sizes, options.quantity)
    return Guidance(
        estimate=found,
        views=count,
        coverage=coverage_of(found, sizes),
        spread=spread,
        proposal=proposal,
        text=_text(found, proposal, now, options, reached=reached),
        reached=reached,
    )


def _of(spread: Spread, quantity: Quantity) -> float:
    return spread.z_um if quantity == "z" else spread.shape_um


def _text(
    found: Estimate, proposal: Proposal | None, now: float | None, options: GuideOptions, *, reached: bool
) -> str:
    what = "Z" if options.quantity == "z" else "shape"
    if reached:
        return f"The uncertainty of {what} at your specimen is {now:.2g} um: the goal of {options.goal_um:g} um is met."
    if found.problem.system_frame is None:
        return "Hold the target where your specimen will be, facing the cameras: the first view is the system frame."
    if proposal is None:
        return "No pose near the specimen shows the whole target to both cameras: use a smaller one, or move it back."
    if proposal.predicted is None:
        return f"{proposal.pose_text}."
    after = _of(proposal.predicted, options.quantity)
    if now is None:
        return f"{proposal.pose_text}: the uncertainty of {what} at your specimen comes to {_um(after)} um."
    return f"{proposal.pose_text}: the uncertainty of {what} at your specimen goes from {_um(now)} to {_um(after)} um."


def _um(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
