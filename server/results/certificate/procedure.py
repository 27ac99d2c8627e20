"""A verification procedure, step by step: the actions at the bench that a plan asks for, and the next one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from stereorig.core.errors import InputError
from stereorig.core.settings import Whole
from stereorig.server.base.models import Request
from stereorig.server.results.certificate.plan import CertificatePlan, Rotation, Translation

Kind = Literal["reference", "static", "translation", "rotation", "length", "free"]
By = Literal["rest", "stage", "hand"]
#: moving parts that a stage moves as a whole, so that one of its moves displaces the specimen against the cameras
_WHOLE = ("target", "both_cameras")
_MOST = 1000


class PlannedProcedure(Request):
    """A plan that is carried out from its first step to its last."""

    plan: CertificatePlan = Field(
        description="The plan; its steps' numbers are those that the test will give. Step 0 is the reference; steps "
        "that it does not name are taken by hand. Without static_steps the first ones that it does not name are static."
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] = Field(1, description="Frames averaged at each step.")


@dataclass(frozen=True)
class ProcedureStep:
    """One step of a procedure.

    Attributes
    ----------
    n
        The number that the test gives it.
    kind
        Purpose of the step.
    by
        Mover of the specimen: ``rest``, nothing moves; ``stage``; ``hand``, a person, who confirms it.
    what
        The action in words.
    label
        Label of the step.
    stage_mm
        Stage position along Z of the system frame, from its position at the reference; None: not moved.
    """

    n: int
    kind: Kind
    by: By
    what: str
    label: str
    stage_mm: float | None


def static_numbers(plan: CertificatePlan) -> list[int]:
    """Return the static steps: those that are named, else the first ones that nothing else is planned for."""
    if plan.static_steps is not None:
        return sorted(plan.static_steps)
    others = set(_named(plan))
    found: list[int] = []
    n = 1
    while len(found) < plan.limits.static_steps:
        found += [n] if n not in others else []
        n += 1
    return found


def procedure_of(plan: CertificatePlan, *, moves: str) -> tuple[ProcedureStep, ...]:
    """Return the steps of a plan in their order.

    Parameters
    ----------
    plan
        The plan.
    moves
        Moving part of the stage, from the rig file. The stage makes a way along Z alone if that is the target or both
        cameras; a person makes every other way.

    Raises
    ------
    InputError
        ``procedure_order`` if a step needs the specimen at its place of the reference, but a step before was moved by
        hand;
        ``procedure_long``.
    """
    static = static_numbers(plan)
    ways, turns = {one.n: one for one in plan.translations}, {one.n: one for one in plan.rotations}
    shown = {one.n: one.name for one in reversed(plan.lengths) if one.n is not None and one.target is not None}
    whole = moves in _WHOLE
    steps = [ProcedureStep(0, "reference", "rest", "Put the speckled body before the cameras.", "reference", None)]
    by_hand: int | None = None
    last = max([*static, *_named(plan)], default=0)
    if last > _MOST:
        raise InputError(
            f"The plan names step {last}; a procedure has at most {_MOST} steps after its reference.",
            code="procedure_long",
            remedy="Number the steps as the test will give them, without gaps.",
        )
    for n in range(1, 1 + last):
        if n in ways:
            step = _way(n, ways[n], whole)
        elif n in turns:
            step = ProcedureStep(n, "rotation", "hand", _turn(turns[n]), "turned", 0.0 if whole else None)
        elif n in static:
            step = ProcedureStep(n, "static", "rest", "Nothing moves.", "static", 0.0 if whole else None)
        elif n in shown:
            text = f"Put the target in the body's place: {shown[n]}."
            step = ProcedureStep(n, "length", "hand", text, shown[n], None)
        else:
            step = ProcedureStep(n, "free", "hand", "The plan names no motion for this step.", "", None)
        if step.by == "hand":
            by_hand = n
        elif by_hand is not None:
            raise InputError(
                f"Step {n} ({step.kind}) needs the body at its place of the reference, and step {by_hand} before it "
                "moves it by hand.",
                code="procedure_order",
                remedy="Number static steps and ways of the stage before all steps that are taken by hand.",
            )
        steps.append(step)
    return tuple(steps)


def next_step(steps: Collection[ProcedureStep], number: int) -> ProcedureStep | None:
    """Return the step that a test's next number is planned for; None after the last one."""
    return next((step for step in steps if step.n == number), None)


def _named(plan: CertificatePlan) -> list[int]:
    """Return the numbers that need a step of their own."""
    targets = [one.n for one in plan.lengths if one.n is not None and one.target is not None]
    return [*(one.n for one in plan.translations), *(one.n for one in plan.rotations), *targets]


def _way(n: int, way: Translation, whole: bool) -> ProcedureStep:
    if way.translation_mm is not None:
        x, y, z = way.translation_mm
        label = f"moved {x:g} {y:g} {z:g} mm"
        if whole and x == 0.0 and y == 0.0:
            return ProcedureStep(n, "translation", "stage", f"The stage moves by {z:g} mm along Z.", label, z)
        text = f"Move the body by X {x:g}, Y {y:g}, Z {z:g} mm from its place at the reference."
    else:
        label = f"moved {way.distance_mm:g} mm"
        text = f"Move the body by {way.distance_mm:g} mm, in any direction, from its place at the reference."
    return ProcedureStep(n, "translation", "hand", text, label, 0.0 if whole else None)


def _turn(turn: Rotation) -> str:
    return "Turn the body." if turn.angle_deg is None else f"Turn the body by {turn.angle_deg:g} degrees."
