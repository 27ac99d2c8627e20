"""Readings and histories of many steps come page by page, and say the same as if they came at once."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import numpy as np
import pytest

import stereorig
from stereorig.server.api.models import GaugesReply
from stereorig.server.workflows.service import Service
from tests.support.model_bench import write_result
from tests.support.service_rig import served, tiny_config
from tests.support.strain_fields import make_field

API = "/api/v1"
TEST, ANALYSIS = "t000004-abcdef", "a000004-abcdef"
STEPS = 115
PATH = f"{API}/tests/{TEST}/analyses/{ANALYSIS}"
BEGAN = datetime(2026, 3, 1, 12, tzinfo=UTC)
MADE = BEGAN.isoformat()
GAUGES: dict[str, Any] = {
    "points": [{"name": "P", "xy_px": [120.0, 100.0]}],
    "extensometers": [{"a_px": [110.0, 90.0], "b_px": [140.0, 90.0]}],
    "variables": ["u_mm", "w_mm"],
}


def drift_mm(n: int) -> float:
    return 1e-3 * n


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service on a drawn analysis of 115 steps: a plane that moves by 1 um along Z at each, and carries a channel."""
    data = tmp_path_factory.mktemp("pages") / "data"
    home = data / "tests" / TEST
    results = home / "analyses" / ANALYSIS
    results.mkdir(parents=True)
    for n in range(STEPS + 1):
        if n > 0:
            way = np.array([0.0, 0.0, drift_mm(n)])
            field = make_field(
                lambda a, b: np.stack([a, b, 0.01 * a], axis=-1),
                lambda x, by=way: x + by,  # type: ignore[misc]
                shape=(6, 7),
            )
            write_result(results, field, n=n, strain_window=None)
        folder = home / "steps" / f"{n:04d}"
        folder.mkdir(parents=True)
        stamp = (BEGAN + timedelta(seconds=n)).isoformat()
        step = {"n": n, "test_id": TEST, "label": "", "timestamp_utc": stamp, "channels": {"stroke_mm": 2.0 * n}}
        (folder / "step.json").write_text(json.dumps(step))
    made = {"id": ANALYSIS, "test_id": TEST, "kind": "displacement", "steps": list(range(STEPS + 1)), "settings": {}}
    (results / "analysis.json").write_text(json.dumps({**made, "created_utc": MADE}))
    document = {"id": TEST, "name": "drift", "calibration_id": None, "created_utc": MADE}
    (home / "test.json").write_text(json.dumps(document))
    service = Service(tiny_config(), data).start()
    try:
        with served(service) as client:
            yield client
    finally:
        service.close()


def pages(client: httpx.Client, body: dict[str, Any], **asked: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    cursor: dict[str, Any] = {}
    while True:
        answer = client.post(f"{PATH}/gauges", json=body, params={**asked, **cursor})
        assert answer.is_success, answer.text
        found.append(answer.json())
        if found[-1]["next_cursor"] is None:
            return found
        cursor = {"cursor": found[-1]["next_cursor"]}


def test_an_answer_holds_a_hundred_steps_and_leads_to_the_next(client: httpx.Client) -> None:
    found = pages(client, GAUGES)
    assert [len(page["steps"]) for page in found] == [100, STEPS - 100]
    steps = [step for page in found for step in page["steps"]]
    assert [step["n"] for step in steps] == list(range(1, STEPS + 1))
    w = [step["points"][0]["values"]["w_mm"]["value"] for step in steps]
    np.testing.assert_allclose(w, [drift_mm(step["n"]) for step in steps], atol=1e-6)


def test_a_frame_and_positions_in_mm_are_laid_through_the_first_step_on_every_page(client: httpx.Client) -> None:
    """A page of its own first step would turn the frame with the specimen, and find other pixels."""
    point = {"name": "P", "xy_mm": [0.1, 0.05]}
    body = {**GAUGES, "points": [point], "align": {"kind": "plane"}, "steps": list(range(1, 21))}
    whole = client.post(f"{PATH}/gauges", json=body)
    assert whole.is_success, whole.text
    parts = pages(client, body, limit=6)
    assert [step for page in parts for step in page["steps"]] == whole.json()["steps"]
    assert {json.dumps(page["alignment"]) for page in parts} == {json.dumps(whole.json()["alignment"])}
    assert all(page["settings"]["steps"] == body["steps"] for page in parts)


def test_a_difference_is_from_its_step_on_every_page(client: httpx.Client) -> None:
    body = {**GAUGES, "difference_from": 7, "steps": list(range(20, 40))}
    for page in pages(client, body, limit=8):
        for step in page["steps"]:
            (found,) = [one["values"] for one in step["differences"] if one["kind"] == "point"]
            assert found["w_mm"]["value"] == pytest.approx(drift_mm(step["n"]) - drift_mm(7), abs=1e-6)


def test_a_table_is_a_file_with_all_steps(client: httpx.Client) -> None:
    table = client.post(f"{PATH}/gauges", json=GAUGES, params={"format": "csv"}).text
    assert f"\n{STEPS}," in table


def test_the_client_puts_the_pages_together(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereorig.client.operations._GAUGE_STEPS", 40)
    with stereorig.Client(str(client.base_url)) as lab:
        found = lab.test(TEST).analysis(ANALYSIS).gauges(**GAUGES)
    assert isinstance(found, GaugesReply)
    assert [step.n for step in found.steps] == list(range(1, STEPS + 1))
    assert len(found.inputs_sha256) == STEPS
    assert found.next_cursor is None


def test_a_history_is_columns_with_what_the_probe_says(client: httpx.Client) -> None:
    where = {"x_px": 121.0, "y_px": 99.0}
    first = client.get(f"{PATH}/history/w_mm", params={**where, "limit": 90}).json()
    second = client.get(f"{PATH}/history/w_mm", params={**where, "cursor": first["next_cursor"]}).json()
    assert (len(first["n"]), len(second["n"]), second["next_cursor"]) == (90, STEPS - 90, None)
    np.testing.assert_allclose(first["value"], [drift_mm(n) for n in first["n"]], atol=1e-6)
    for name in ("w_mm", "d_mm", "zncc_max"):
        history = client.get(f"{PATH}/history/{name}", params={**where, "limit": 3})
        probe = client.get(f"{PATH}/probe", params={**where, "step": 3}).json()
        if name not in probe["values"]:
            assert (history.status_code, history.json()["code"]) == (404, "field_missing")
            continue
        found = history.json()
        assert (found["row"], found["col"]) == (probe["row"], probe["col"])
        assert (found["value"][2], found["sigma"][2]) == (
            probe["values"][name]["value"],
            probe["values"][name]["sigma"],
        )
        assert found["units"] == probe["values"][name]["units"]


def test_the_channels_of_many_steps_come_with_their_list(client: httpx.Client) -> None:
    plain = client.get(f"{API}/tests/{TEST}/steps", params={"limit": 3}).json()["steps"]
    assert [one["channels"] for one in plain] == [None] * 3
    with_them = client.get(f"{API}/tests/{TEST}/steps", params={"limit": 3, "channels": True}).json()["steps"]
    assert [one["channels"] for one in with_them] == [{"stroke_mm": 2.0 * n} for n in range(3)]


def test_a_record_for_many_steps_is_summed_up(client: httpx.Client) -> None:
    rows = [f"{(BEGAN + timedelta(seconds=n)).isoformat()},{n}" for n in range(110)]
    content = "\n".join(["Time,Force (kN)", *rows]).encode()
    answer = client.post(f"{API}/tests/{TEST}/channels:import", files={"file": ("f.csv", content)})
    assert answer.is_success, answer.text
    found = answer.json()
    assert (found["n_steps"], found["n_aligned"]) == (STEPS + 1, 110)
    assert found["reasons"] == {"it is outside the record": STEPS + 1 - 110}
    assert [one["n"] for one in found["steps"]] == list(range(100))
    further = {"cursor": found["steps_next_cursor"], "channels": True}
    others = client.get(f"{API}/tests/{TEST}/steps", params=further).json()["steps"]
    assert [one["n"] for one in others] == list(range(100, STEPS + 1))
    assert [one["n"] for one in others if "force_kn" in one["channels"]] == list(range(100, 110))
