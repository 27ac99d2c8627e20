"""Certificates through the images: a whole rig passes, a hidden fault is named; what is missing is told."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tifffile

from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.service_rig import SMALL, served, wait_for_job, wait_for_rig

# A verification procedure on the simulated rig, through its images, with a hidden fault.

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


Taken = tuple[str, str, dict[str, Any]]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, httpx.Client, Taken]]:
    """A service on a rig without a fault, with the procedure taken and measured."""
    data = tmp_path_factory.mktemp("certify") / "data"
    service = Service(parse_config(rig_text(Fault())), data).start()
    try:
        with served(service) as client:
            yield data, client, take(client, Fault())
    finally:
        service.close()


def certified(client: httpx.Client, taken: Taken, **changes: Any) -> dict[str, Any]:
    """Make a certificate; return its job as it ended."""
    body = {"test_id": taken[0], "analysis_id": taken[1], "plan": {**taken[2], **changes}}
    answer = client.post(f"{API}/certificates", json=body)
    assert answer.status_code == 202, answer.text
    return wait_for_job(client, answer.json()["job"])


def command(data: Path, plan: dict[str, Any], out: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run the command; return its status and all that it printed."""
    out.mkdir()
    (out / "plan.json").write_text(json.dumps(plan))
    status = main(["certify", str(data), str(out / "plan.json"), "--out", str(out / "made")])
    printed = capsys.readouterr()
    return status, printed.out + printed.err


def test_a_rig_without_a_fault_passes_and_its_certificate_is_kept(bench: tuple[Path, httpx.Client, Taken]) -> None:
    data, client, taken = bench
    done = certified(client, taken)
    assert done["state"] == "succeeded", done["problem"]
    assert done["result"]["outcome"] == "pass"
    certificate_id = done["result"]["certificate_id"]
    shown = client.get(f"{API}/certificates/{certificate_id}").json()
    assert (shown["state"], shown["reasons"], shown["suspects"]) == ("valid", [], [])
    assert {row["name"] for row in shown["noise_floor"]} == {"u_mm", "v_mm", "w_mm", "exx", "eyy", "exy"}
    assert len([one for one in shown["comparisons"] if one["group"] == "length"]) == 6
    page = client.get(f"{API}/certificates/{certificate_id}/report")
    assert page.headers["content-security-policy"].startswith("default-src 'none'")
    assert 'data-outcome="pass"' in page.text
    assert "simulated rig" in page.text
    assert client.get(f"{API}/certificates").json()["certificates"][-1]["id"] == certificate_id
    kept = json.loads((data / "certificates" / certificate_id / "certificate.json").read_text())
    step = kept["made_of"]["steps"]["1"]
    assert step == json.loads((data / "tests" / taken[0] / "steps" / "0001" / "step.json").read_text())["sha256"]
    assert main(["verify", str(data)]) == 0
    page_file = data / "certificates" / certificate_id / "certificate.html"
    whole = page_file.read_bytes()
    page_file.write_bytes(whole[:-1])
    assert main(["verify", str(data)]) == 1
    refused = client.get(f"{API}/certificates/{certificate_id}/report")
    assert refused.json()["code"] == "checksum_mismatch"
    page_file.write_bytes(whole)


def test_a_target_of_known_size_is_a_length(bench: tuple[Path, httpx.Client, Taken]) -> None:
    _, client, taken = bench
    client.put(f"{API}/sim/scene", json={"scene": "grid"}).raise_for_status()
    n = client.post(f"{API}/tests/{taken[0]}/steps", json={"label": "target", "frames": 4}).json()["n"]
    target = tomllib.loads(rig_text(Fault()))["target"]
    place = {"name": "grid", "n": n, "target": target}
    done = certified(client, taken, lengths=[place, {**place, "name": "again"}], limits={"lengths": 2})
    assert done["state"] == "succeeded", done["problem"]
    shown = client.get(f"{API}/certificates/{done['result']['certificate_id']}").json()
    found = [one for one in shown["comparisons"] if one["group"] == "length"]
    assert [one["name"] for one in found] == ["grid", "again"]
    assert done["result"]["outcome"] == "pass", shown["reasons"]
    assert len(shown["made_of"]["pictures_sha256"]) == 4
    assert client.delete(f"{API}/tests/{taken[0]}/steps/{n}").json()["code"] == "in_use"
    stated = {**target, "pitch_mm": 1.002 * target["pitch_mm"]}
    wrong = certified(client, taken, lengths=[{**place, "target": stated}], limits={"lengths": 1})
    assert wrong["result"]["outcome"] == "fail"


def test_what_a_certificate_rests_on_is_kept_until_it_is_withdrawn(bench: tuple[Path, httpx.Client, Taken]) -> None:
    _, client, taken = bench
    spare = client.post(f"{API}/tests/{taken[0]}/steps", json={"label": "after"}).json()["n"]
    made = certified(client, taken)["result"]["certificate_id"]
    for address in ("", "/steps/1", f"/analyses/{taken[1]}"):
        refused = client.delete(f"{API}/tests/{taken[0]}{address}")
        assert refused.status_code == 409, refused.text
        assert refused.json()["code"] == "in_use"
        assert "certificate v" in refused.json()["detail"]
    assert client.delete(f"{API}/tests/{taken[0]}/steps/{spare}").is_success  # no part of it
    for one in client.get(f"{API}/certificates").json()["certificates"]:
        withdrawn = client.post(f"{API}/certificates/{one['id']}:withdraw", json={"reason": "another lens"})
        assert withdrawn.json()["state"] == "withdrawn"
        assert "another lens" in withdrawn.json()["why"]
    again = client.post(f"{API}/certificates/{made}:withdraw", json={"reason": "once more"})
    assert (again.status_code, again.json()["code"]) == (409, "certificate_withdrawn")
    gone = client.delete(f"{API}/tests/{taken[0]}/steps/8")
    assert gone.is_success
    client.post(f"{API}/trash/{gone.json()['id']}:restore").raise_for_status()


def test_errors_beyond_the_permissible_fail_and_name_the_figures(
    bench: tuple[Path, httpx.Client, Taken], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, _, taken = bench
    off = [{**one, "length_mm": one["length_mm"] * 1.001} for one in taken[2]["lengths"]]
    status, printed = command(data, {**taken[2], "lengths": off}, tmp_path / "off", capsys)
    assert status == 5
    assert "suspect: known_length" in printed  # ways are right, lengths are not
    wide = {**taken[2], "limits": {"length_mpe_um": 50.0}, "lengths": off}
    status, printed = command(data, wide, tmp_path / "wide", capsys)
    assert status == 4
    assert "within the permissible 50 um" in printed


def test_the_class_of_the_extensometer_follows_from_the_reference(
    bench: tuple[Path, httpx.Client, Taken], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, _, taken = bench
    # a body that only moves: the true elongation is zero, and 0.6 um are permitted
    readings = [{"n": n, "elongation_mm": 0.0} for n in range(4, 9)]
    reference = {"a_px": [70, 120], "b_px": [180, 120], "readings": readings, "u_mm": 1e-5, "gauge_length_mm": None}
    plan = {**taken[2], "extensometer": reference, "limits": {"extensometer_class": "2"}}
    status, printed = command(data, plan, tmp_path / "five", capsys)
    assert status == 4
    assert "5 readings; 10 are needed" in printed
    assert "class of the virtual extensometer: " in printed
    plan["extensometer"] = {**reference, "readings": [{**one, "elongation_mm": 0.05} for one in readings]}
    status, printed = command(data, plan, tmp_path / "off", capsys)
    assert status == 5
    assert "reaches no class; class 2 was asked for" in printed


def test_what_is_missing_is_told_and_nothing_is_lost(
    bench: tuple[Path, httpx.Client, Taken], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, client, taken = bench
    before = [one["id"] for one in client.get(f"{API}/certificates").json()["certificates"]]
    done = certified(client, taken, static_steps=[1, 2, 77])
    assert (done["state"], done["problem"]["code"]) == ("failed", "certificate_step_missing")
    board = {"kind": "checkerboard", "pitch_mm": 1.0, "size": [5, 4]}
    place = {"name": "board", "target": board, "n": 55}
    done = certified(client, taken, lengths=[place])
    assert (done["state"], done["problem"]["code"]) == ("failed", "certificate_picture_missing")
    assert done["problem"]["remedy"]
    assert [one["id"] for one in client.get(f"{API}/certificates").json()["certificates"]] == before

    copy = tmp_path / "data"
    shutil.copytree(data, copy)
    image = copy / "tests" / taken[0] / "steps" / "0002" / "cam2.tif"
    image.unlink()
    status, printed = command(copy, taken[2], tmp_path / "gone", capsys)
    assert status == 1
    assert "certificate_inputs_changed" in printed
    assert "cam2 of step 2 is gone" in printed
    assert not (tmp_path / "gone" / "made").exists()
    tifffile.imwrite(image, np.zeros((240, 256), np.uint8))
    assert "cam2 of step 2 was replaced" in command(copy, taken[2], tmp_path / "other", capsys)[1]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"translations": [{"n": 1}]}, "give translation_mm or distance_mm"),
        ({"static_steps": [4], "translations": [{"n": 4, "distance_mm": 1.0}]}, "step 4 is named twice"),
        ({"lengths": [{"name": "x", "n": 1}]}, "give n, a_px, b_px and length_mm, or a target"),
        ({"valid_days": 0}, "valid_days"),
        ({"limits": {"extensometer_class": "3"}}, "extensometer_class"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(
    change: dict[str, Any], code: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, printed = command(tmp_path, change, tmp_path / "x", capsys)
    assert status == 1
    assert "certificate_plan_invalid" in printed
    assert code in printed


@pytest.mark.deep
@pytest.mark.parametrize(
    ("fault", "suspect"),
    [
        (Fault(pitch=1e-3), "calibration_scale"),
        (Fault(heat_mm=(0.0, 0.0, 5e-4)), "drift"),
        (Fault(bump_deg=0.003), "camera_moved"),
    ],
    ids=["pitch", "heated", "bumped"],
)
def test_a_hidden_fault_fails_the_rig_and_is_the_first_suspect(fault: Fault, suspect: str, tmp_path: Path) -> None:
    service = Service(parse_config(rig_text(fault)), tmp_path / "data").start()
    try:
        with served(service) as client:
            done = certified(client, take(client, fault))
            assert done["result"]["outcome"] == "fail", done["problem"]
            shown = client.get(f"{API}/certificates/{done['result']['certificate_id']}").json()
    finally:
        service.close()
    assert shown["suspects"][0]["code"] == suspect, shown["suspects"]
    assert (shown["state"], shown["valid_until_utc"]) == ("failed", None)
