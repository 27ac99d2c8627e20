"""A verification procedure on the rig: the stage's ways by the stage, the others by a person, until a certificate."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import InputError
from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.results.certificate.plan import CertificatePlan
from stereorig.server.results.certificate.procedure import procedure_of
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, new_test, served, true_cameras, wait_for_job, wait_for_rig

API = "/api/v1"
WAY_MM = 0.3
PLAN: dict[str, Any] = {
    "title": "guided",
    "translations": [{"n": 3, "translation_mm": [0.0, 0.0, WAY_MM], "u_mm": 1e-3}, {"n": 5, "distance_mm": 0.2}],
    "rotations": [{"n": 6, "angle_deg": 1.0, "u_deg": 1e-3}],
    "limits": {"static_steps": 2, "translations": 2, "lengths": 0},
}


def planned(moves: str, **changes: Any) -> list[tuple[str, str, float | None]]:
    steps = procedure_of(CertificatePlan.model_validate({**PLAN, **changes}), moves=moves)
    return [(step.kind, step.by, step.stage_mm) for step in steps]


def test_the_stage_does_what_it_can_and_static_steps_fill_the_gaps() -> None:
    by_stage = [
        ("reference", "rest", None),
        ("static", "rest", 0.0),
        ("static", "rest", 0.0),
        ("translation", "stage", WAY_MM),
        ("free", "hand", None),
        ("translation", "hand", 0.0),
        ("rotation", "hand", 0.0),
    ]
    assert planned("target") == planned("both_cameras") == by_stage
    # cameras that each go along their own axis, and a free stage, give the specimen no way
    for moves in ("cameras", "free"):
        assert planned(moves)[3] == ("translation", "hand", None)


def test_a_step_that_needs_the_body_in_place_after_one_by_hand_is_refused() -> None:
    with pytest.raises(InputError, match=r"Step 7 .* step 6 before it") as refused:
        planned("target", static_steps=[1, 2, 7], translations=[])
    assert refused.value.code == "procedure_order"


def test_a_plan_with_a_number_far_out_is_refused() -> None:
    with pytest.raises(InputError) as refused:
        planned("target", rotations=[{"n": 9000}])
    assert refused.value.code == "procedure_long"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, httpx.Client]]:
    """A rig whose one stage axis moves the target, with its own true cameras as calibration."""
    text = SMALL.replace("stage_axis = 2", "stage_axis = 1")
    text = text.replace("[calibration]\n", '[calibration]\nmoves = "target"\n')
    text = text.replace("[sim]\n", '[sim]\nstage_moves = "target"\n')
    data = tmp_path_factory.mktemp("procedure") / "data"
    service = Service(parse_config(text), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            client.put(f"{API}/sim/scene", json=scene()).raise_for_status()
            yield data, client
    finally:
        service.close()


def scene(way: tuple[float, ...] = (0.0, 0.0, 0.0), turn: float = 0.0) -> dict[str, Any]:
    params = {"translation_mm": [*way], "rotation_rad": [0.0, 0.0, turn]}
    return {"scene": "block", "load": 1.0, "params": params}


def calibrated_test(client: httpx.Client) -> str:
    file = {"file": ("c.json", json.dumps(true_cameras(SMALL)))}
    imported = client.post(f"{API}/calibrations:import", files=file).json()["id"]
    return new_test(client, calibration_id=imported)


def take(client: httpx.Client, path: str, **body: Any) -> dict[str, Any]:
    answer = client.post(f"{path}:next", json=body)
    assert answer.status_code == 202, answer.text
    done = wait_for_job(client, answer.json()["job"])
    assert done["state"] == "succeeded", done["problem"]
    return dict(done["result"])


def test_a_plan_is_carried_out_step_by_step_and_judged(bench: tuple[Path, httpx.Client]) -> None:
    data, client = bench
    test_id = calibrated_test(client)
    path = f"{API}/tests/{test_id}/certificate-plan"
    assert (client.get(path).json()["plan"], client.get(path).json()["steps"]) == (None, [])
    assert client.post(f"{path}:next").json()["code"] == "procedure_missing"
    before = client.put(path, json={"plan": PLAN, "frames": 4}).json()
    assert (before["next"], {one["state"] for one in before["steps"]}) == (0, {"to_come"})
    taken = [take(client, path) for _ in range(4)]
    assert [(one["n"], one["kind"]) for one in taken] == [
        (0, "reference"),
        (1, "static"),
        (2, "static"),
        (3, "translation"),
    ]
    refused = client.post(f"{path}:next", json={})
    assert (refused.status_code, refused.json()["code"]) == (409, "procedure_by_hand")
    take(client, path, confirmed=True)  # a step that the plan does not name
    # somebody shifts the body, and turns it
    client.put(f"{API}/sim/scene", json=scene(way=(0.0, 0.2, 0.0))).raise_for_status()
    assert "by 0.2 mm" in client.post(f"{path}:next", json={}).json()["detail"]
    take(client, path, confirmed=True)
    client.put(f"{API}/sim/scene", json=scene(turn=float(np.radians(1.0)))).raise_for_status()
    take(client, path, confirmed=True)
    client.put(f"{API}/sim/scene", json=scene()).raise_for_status()
    done = client.get(path).json()
    assert (done["next"], {one["state"] for one in done["steps"]}) == (None, {"taken"})
    assert client.post(f"{path}:next", json={}).json()["code"] == "procedure_complete"
    steps = client.get(f"{API}/tests/{test_id}/steps").json()["steps"]
    assert [one["label"] for one in steps[:4]] == ["reference", "static", "static", "moved 0 0 0.3 mm"]

    asked = {"region": {"rectangle": [70, 70, 180, 170]}, "subset_px": 21, "spacing_px": 14, "strain": {"window": 3}}
    accepted = client.post(f"{API}/tests/{test_id}/analyses", json=asked).json()
    assert wait_for_job(client, accepted["job"])["state"] == "succeeded"
    body = {"test_id": test_id, "analysis_id": accepted["analysis_id"], "plan": done["plan"]}
    job = wait_for_job(client, client.post(f"{API}/certificates", json=body).json()["job"])
    assert job["state"] == "succeeded", job["problem"]
    shown = client.get(f"{API}/certificates/{job['result']['certificate_id']}").json()
    ways = {
        one["n"]: one for one in shown["comparisons"] if one["group"] == "displacement" and one["name"].startswith("Z")
    }
    # the stage went the way that the plan states: the rig's own truth, seen through its images
    assert ways[3]["known"] == pytest.approx(WAY_MM)
    assert ways[3]["measured"] == pytest.approx(WAY_MM, abs=3e-3)
    assert not [one for one in shown["reasons"] if one["code"] == "too_few"]
    assert main(["verify", str(data)]) == 0


def test_a_deleted_step_is_missing_and_its_number_is_not_taken_again(bench: tuple[Path, httpx.Client]) -> None:
    _, client = bench
    test_id = new_test(client)
    path = f"{API}/tests/{test_id}/certificate-plan"
    client.put(path, json={"plan": PLAN}).raise_for_status()
    for _ in range(2):
        take(client, path)
    client.delete(f"{API}/tests/{test_id}/steps/1").raise_for_status()
    now = client.get(path).json()
    assert [one["state"] for one in now["steps"][:3]] == ["taken", "missing", "to_come"]
    assert now["next"] == 2


def test_a_stage_that_cannot_reach_takes_no_step(bench: tuple[Path, httpx.Client]) -> None:
    _, client = bench
    test_id = new_test(client)
    path = f"{API}/tests/{test_id}/certificate-plan"
    far = {"translations": [{"n": 1, "translation_mm": [0.0, 0.0, 60.0]}], "static_steps": []}
    client.put(path, json={"plan": far}).raise_for_status()
    take(client, path)
    done = wait_for_job(client, client.post(f"{path}:next").json()["job"])
    assert (done["state"], done["problem"]["code"]) == ("failed", "out_of_limits")
    assert client.get(path).json()["next"] == 1


def test_the_same_key_takes_one_step(bench: tuple[Path, httpx.Client]) -> None:
    _, client = bench
    test_id = new_test(client)
    path = f"{API}/tests/{test_id}/certificate-plan"
    client.put(path, json={"plan": PLAN}).raise_for_status()
    jobs = {client.post(f"{path}:next", headers={"Idempotency-Key": "once"}).json()["job"]["id"] for _ in range(2)}
    assert len(jobs) == 1
    wait_for_job(client, {"id": jobs.pop()})
    assert client.get(path).json()["next"] == 1


def test_the_command_refuses_before_the_first_step_what_it_could_not_measure(
    bench: tuple[Path, httpx.Client], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, client = bench
    test_id = new_test(client)
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(PLAN))
    assert main(["certify", "--run", str(plan), "--test", test_id, "--url", str(client.base_url)]) == 1
    assert "not_calibrated" in capsys.readouterr().err
    assert client.get(f"{API}/tests/{test_id}/steps").json()["steps"] == []


def test_the_command_asks_for_what_is_done_by_hand_and_goes_on_to_the_certificate(
    bench: tuple[Path, httpx.Client],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, client = bench
    test_id = calibrated_test(client)
    plan, recipe, out = tmp_path / "plan.json", tmp_path / "recipe.json", tmp_path / "out"
    plan.write_text(json.dumps(PLAN))
    settings = {"subset_px": 21, "spacing_px": 14, "strain": {"window": 3}}
    region = {"rectangle": [70, 70, 180, 170]}
    recipe.write_text(json.dumps({"format": "stereorig recipe", "version": 1, "region": region, "settings": settings}))
    command = ["certify", "--run", str(plan), "--test", test_id, "--url", str(client.base_url)]
    command += ["--recipe", str(recipe), "--out", str(out), "--json", "--frames", "4"]
    asked: list[str] = []

    def nobody(_prompt: str) -> str:
        if len(asked) == 1:
            raise EOFError
        asked.append("reference")
        return ""

    monkeypatch.setattr("builtins.input", nobody)
    assert main(command) == 1
    printed = capsys.readouterr()
    assert "procedure_by_hand" in printed.err
    assert "step 4 of 6" in printed.err
    by_hand = iter([scene(), scene(way=(0.0, 0.2, 0.0)), scene(turn=float(np.radians(1.0)))])

    def somebody(_prompt: str) -> str:
        client.put(f"{API}/sim/scene", json=next(by_hand)).raise_for_status()
        return ""

    monkeypatch.setattr("builtins.input", somebody)
    status = main(command)  # what is taken stays taken
    printed = capsys.readouterr()
    client.put(f"{API}/sim/scene", json=scene()).raise_for_status()
    assert "step 3 of 6" not in printed.err
    assert "step 6 of 6: Turn the body by 1 degrees." in printed.err
    # measured as the recipe says, and judged: the service's certificate, the files and the exit status say the same
    kept = client.get(f"{API}/certificates").json()["certificates"][-1]
    assert kept["test_id"] == test_id
    analysis = client.get(f"{API}/tests/{test_id}/analyses/{kept['analysis_id']}").json()
    assert (analysis["settings"]["subset_px"], analysis["steps"]) == (21, [*range(7)])
    document = json.loads(printed.out)
    assert document["id"] == kept["id"]
    assert json.loads((out / "certificate.json").read_text()) == document
    assert (out / "certificate.html").read_bytes() == client.get(f"{API}/certificates/{kept['id']}/report").content
    assert status == {"pass": 0, "conditional": 4, "fail": 5}[kept["outcome"]]
    ways = {one["n"]: one for one in document["comparisons"] if one["group"] == "displacement"}
    assert ways[3]["known"] == pytest.approx(WAY_MM)
    # the certificate of what the body went, by hand, as the rig's truth has it
    assert ways[5]["measured"] == pytest.approx(0.2, abs=3e-3)


def test_without_a_recipe_the_specimen_is_found_and_a_target_shown_is_not_measured(
    bench: tuple[Path, httpx.Client],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, client = bench
    test_id = calibrated_test(client)
    target = {"kind": "checkerboard", "pitch_mm": 4.0, "size": [9, 6]}
    asked = {"static_steps": [1], "lengths": [{"name": "board", "n": 2, "target": target}]}
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(asked))
    monkeypatch.setattr("builtins.input", lambda _: "")
    # no board is shown, so there is no certificate; the body was measured all the same, by the region that was found
    assert main(["certify", "--run", str(plan), "--test", test_id, "--url", str(client.base_url)]) != 0
    printed = capsys.readouterr()
    assert "region: " in printed.err
    analyses = client.get(f"{API}/tests/{test_id}").json()["analyses"]
    assert len(analyses) == 1
    analysis = client.get(f"{API}/tests/{test_id}/analyses/{analyses[0]['id']}").json()
    assert analysis["steps"] == [0, 1]
    assert analysis["settings"]["strain"] is not None
