"""A verification procedure on the simulated rig, through its images, with a hidden fault."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.service_rig import SMALL, wait_for_job, wait_for_rig

API = "/api/v1"
REGION = {"rectangle": [60, 60, 190, 180]}
ENDS = (((70.0, 120.0), (180.0, 120.0)), ((125.0, 70.0), (125.0, 170.0)), ((75.0, 75.0), (175.0, 165.0)))
#: forth and back, so that a scale error is no drift
WAYS_MM = ((0.2, 0.0, 0.0), (0.0, 0.0, 0.3), (0.0, -0.2, 0.0), (0.1, 0.0, -0.3))
TURN_RAD = (0.0, 0.0, 0.02)
STATIC = 3


@dataclass(frozen=True)
class Fault:
    """Hidden faults: of the target's pitch, a heated mount that moves the specimen at each step, a bump of camera 2."""

    pitch: float = 0.0
    heat_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bump_deg: float = 0.0


def rig_text(fault: Fault) -> str:
    """The small rig with its hidden pitch."""
    return SMALL + f"\n[sim.target]\npitch_error = {fault.pitch}\n"


def true_length_mm(fault: Fault, ends: tuple[tuple[float, float], tuple[float, float]]) -> float:
    """Distance of the body's points that camera 1 truly sees at two pixels at the reference."""
    import tomllib

    world = SimWorld(SimRig.from_dict(tomllib.loads(rig_text(fault))), lambda _axis: 0.0)
    found = world.truth(np.array(ends), "block")
    return float(np.linalg.norm(found.xyz_mm[1] - found.xyz_mm[0]))


def take(client: httpx.Client, fault: Fault) -> tuple[str, str, dict[str, Any]]:
    """Take the whole procedure; return test, analysis and the plan that states what a user knows."""
    wait_for_rig(client)
    accepted = client.post(f"{API}/calibrations", json={}).json()
    done = wait_for_job(client, accepted["job"])
    assert done["state"] == "succeeded", done["problem"]
    body = {"name": "bench", "calibration_id": accepted["calibration_id"]}
    test_id = str(client.post(f"{API}/tests", json=body).json()["id"])
    taken = 0

    def step(label: str, way: tuple[float, ...] = (0.0, 0.0, 0.0), turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> int:
        nonlocal taken
        hot = taken * np.array(fault.heat_mm)
        params: dict[str, Any] = {"translation_mm": [*(np.array(way) + hot)], "rotation_rad": [*turn]}
        if fault.bump_deg:
            params["bump_cam2"] = [fault.bump_deg, 0.0, 0.0, 0.0, 0.0, 0.0]
        scene = {"scene": "block", "load": 1.0, "params": params}
        client.put(f"{API}/sim/scene", json=scene).raise_for_status()
        stamp = f"2026-03-01T12:{taken:02d}:00Z"
        sent = {"label": label, "timestamp_utc": stamp, "frames": 4}
        client.post(f"{API}/tests/{test_id}/steps", json=sent).raise_for_status()
        taken += 1
        return taken - 1

    step("reference")
    for _ in range(STATIC):
        step("static")
    ways = [{"n": step("moved", way), "translation_mm": list(way), "u_mm": 1e-5} for way in WAYS_MM]
    turned = step("turned", turn=TURN_RAD)
    asked = {"region": REGION, "subset_px": 21, "spacing_px": 8, "strain": {"window": 5}}
    accepted = client.post(f"{API}/tests/{test_id}/analyses", json=asked).json()
    done = wait_for_job(client, accepted["job"])
    assert done["state"] == "succeeded", done["problem"]
    lengths = [
        {"name": f"length {k}, step {n}", "artefact": f"{k}", "n": n, "a_px": ends[0], "b_px": ends[1]}
        | {"length_mm": true_length_mm(fault, ends), "u_mm": 1e-5}
        for k, ends in enumerate(ENDS)
        for n in (1, ways[1]["n"])
    ]
    angle = float(np.degrees(np.linalg.norm(TURN_RAD)))
    plan = {
        "title": "small bench",
        "translations": ways,
        "rotations": [{"n": turned, "angle_deg": angle, "u_deg": 1e-4}],
        "lengths": lengths,
    }
    return test_id, str(accepted["analysis_id"]), plan
