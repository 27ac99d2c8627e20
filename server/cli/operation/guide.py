"""``stereorig guide``: a guided acquisition of free poses on a running service, line by line."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereorig.core.errors import InputError, MeasurementError, StateError
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.demo.client import ServiceClient
from stereorig.server.formats.files import write_bytes

_POLL_S = 0.2
_MOST_GOAL_UM = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Take views of the target held by hand, each when it is at rest in a new pose, and fit both cameras. Printed "
        "are the cover by the views, and the next most useful one. Hold the target first where the specimen will be. "
        "Ctrl-C ends without a fit; the views are kept."
    )
    parser.add_argument("--url", default="http://127.0.0.1:8000", help="address of the service (default: %(default)s)")
    parser.add_argument("--key", metavar="KEY", help="key of the service, if it requires one")
    parser.add_argument("--goal-um", type=float, metavar="UM", help="stop below this uncertainty, micrometres")
    parser.add_argument(
        "--quantity", choices=("z", "shape"), default="z", help="uncertainty that the goal is about (default: z)"
    )
    parser.add_argument("--views", type=int, metavar="N", help="stop after so many views, goal or not")
    parser.add_argument("--frames", type=int, default=1, metavar="N", help="frames averaged for a view (default: 1)")
    parser.add_argument("--label", default="", help="free text kept with the calibration")
    parser.add_argument(
        "--out", metavar="FILE", help="write calibration.json there, too; the service keeps it in any case"
    )


def run(args: argparse.Namespace) -> int:
    """Acquire, fit, print."""
    if args.goal_um is not None and not 0.0 < args.goal_um <= _MOST_GOAL_UM:
        raise InputError(f"--goal-um {args.goal_um:g} is not above 0 and up to {_MOST_GOAL_UM:g} um.")
    if args.views is not None and args.views < 3:
        raise InputError(f"--views {args.views}: at least three poses are needed.")
    line = ProgressLine()
    headers = {} if args.key is None else {"Authorization": f"Bearer {args.key}"}
    with ServiceClient(args.url.rstrip("/"), headers=headers) as client, contextlib.closing(line):
        rig = client.get("/rig")
        hand = _Hand(client, rig) if rig["sim"] else None
        if hand is not None:
            hand.hold([0.0] * 6)
        body = {"goal_um": args.goal_um, "quantity": args.quantity, "frames": args.frames, "label": args.label}
        begun = client.call("POST", "/calibrations:guide", json=body).json()
        session = _Session(client, str(begun["calibration_id"]), str(begun["job"]["id"]), args.views, line, hand)
        who = "your hand" if hand is None else "the simulated hand"
        line.note(f"calibration {session.calibration_id}: {who} holds the target where the specimen will be")
        try:
            session.acquire()
        except BaseException:
            with contextlib.suppress(StateError):
                client.call("POST", f"/jobs/{session.job_id}:cancel")
            raise
        return session.result(args.out)


@dataclass(eq=False)
class _Hand:
    """A simulated hand before a simulated rig: it takes the poses that the guide asks for."""

    client: ServiceClient
    rig: Mapping[str, Any]

    def hold(self, pose: list[float]) -> None:
        """Hold the rig's target in a pose of the system frame."""
        self.client.set_scene(self.rig["target"].get("kind", "line_grid"), pose=pose)


@dataclass(eq=False)
class _Session:
    client: ServiceClient
    calibration_id: str
    job_id: str
    most_views: int | None
    line: ProgressLine
    hand: _Hand | None
    _taken: int = -1
    _last: dict[str, Any] = field(default_factory=dict)

    def acquire(self) -> None:
        """Follow the acquisition to its end."""
        path = f"/calibrations/{self.calibration_id}/guide"
        while True:
            state = self.client.get(path)
            guidance = state["guidance"]
            new = guidance is not None and guidance["taken"] != self._taken
            if new:
                self._taken, self._last = guidance["taken"], guidance
                self._tell(guidance)  # of the last view, too, after which the acquisition may be over
            if state["state"] != "acquiring":
                return
            if new:
                if self.most_views is not None and guidance["used"] >= self.most_views:
                    self.client.call("POST", f"{path}:finish")
                elif self.hand is not None and guidance["proposal"] is not None:
                    self.hand.hold(guidance["proposal"]["pose"])
            self.line.status(_live_text(state))
            time.sleep(_POLL_S)

    def _tell(self, guidance: Mapping[str, Any]) -> None:
        if guidance["taken"]:
            share = guidance["coverage"]["share"]
            spread = guidance["uncertainty"]
            figures = "" if spread is None else f", Z {spread['z_um']:.3g} um, shape {spread['shape_um']:.3g} um"
            kind = "" if guidance["adjusted"] else " by nominal lenses"
            self.line.note(
                f"view {guidance['taken']}: cam1 {100 * share['cam1']:.0f} %, cam2 {100 * share['cam2']:.0f} % of the "
                f"image{figures}{kind}"
            )
            for one in guidance["left_out"]:
                if one["view"] == guidance["taken"] - 1:
                    self.line.note(f"  left out, {one['camera']}: {one['reason']}")
        self.line.note(f"  {guidance['text']}")

    def result(self, out: str | None) -> int:
        """Wait for the fit and print its verdict; 1 where the verdict is no good one."""
        self.line.status("fitting")
        self.client.wait(self.job_id)
        made = self.client.get(f"/calibrations/{self.calibration_id}")
        verdict = made.get("verdict")
        if not isinstance(verdict, dict):
            raise MeasurementError(f"Calibration {self.calibration_id} has no verdict.", code="calibration_rejected")
        shape_um = 1e3 * float(made["uncertainty"]["shape_rms_mm"])
        self.line.note(
            f"verdict: {verdict['level']}; lens {made['lens']['model']}; shape {shape_um:.3g} um rms; "
            f"calibration {self.calibration_id}"
        )
        for reason in verdict["reasons"]:
            self.line.note(f"  {reason}")
        if out is not None:
            write_bytes(Path(out), self.client.call("GET", f"/calibrations/{self.calibration_id}/file").content)
            self.line.note(f"wrote {out}")
        return 0 if verdict["level"] != "failed" else 1


def _live_text(state: Mapping[str, Any]) -> str:
    look = state["live"]
    if look is None:
        return "looking for the target"
    for cam, seen in look["cameras"].items():
        if seen["problem"] is not None:
            return f"{cam}: {seen['problem']['cause']}"
    points = ", ".join(f"{cam} {seen['found']} points" for cam, seen in look["cameras"].items())
    if not look["still"]:
        moved = look["moved_px"]
        return f"{points}; moving" + ("" if moved is None else f" by {moved:.1f} px")
    return f"{points}; at rest, " + ("new" if look["new"] else f"like view {(look['like_view'] or 0) + 1}")
