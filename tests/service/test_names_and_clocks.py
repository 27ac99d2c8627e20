"""Labels are data and never paths; clocks that jump change no order; folders of other versions."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import stereorig.server.store.folder
from stereorig.core.errors import FileFormatError
from stereorig.server.formats.images import encode_tiff
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.problems import assert_problem
from tests.support.service_rig import served, tiny_config, wait_for_job, wait_for_rig

API = "/api/v1"

NAMES = [
    "Zugprobe №7 – 45° / Öl, 東京, 🧪, עברית",
    "  leading, trailing and  doubled  ",
    "x" * 300,
    "東" * 300,
    "..",
    "../../../../etc/passwd",
    "/etc/passwd",
    "C:\\Windows\\system32",
    "CON",
    "nul.txt",
    ".hidden",
    "-rf",
    "~root",
    "$(reboot) `id` %s {0} ; DROP TABLE jobs; --",
    "e\u0301 beside \u00e9",
    "<script>alert(1)</script>",
    "step.json",
    "0000",
]


@pytest.mark.fault(9)
@pytest.mark.fault(46)
def test_every_label_is_kept_to_the_letter_and_names_no_file(service: Service, client: httpx.Client) -> None:
    wait_for_rig(client)
    root = service.folder.root
    outside = sorted(p.name for p in root.parent.iterdir())
    pair = {
        cam: encode_tiff(np.random.default_rng(k).integers(0, 255, (144, 160)).astype(np.uint8))
        for k, cam in enumerate(("cam1", "cam2"))
    }
    for name in NAMES:
        body = {"name": name, "specimen": name, "notes": name}
        made = client.post(f"{API}/tests", json=body)
        assert made.status_code == 201, (name, made.text)
        test_id = made.json()["id"]
        shown = client.get(f"{API}/tests/{test_id}").json()
        assert {k: shown[k] for k in body} == body
        step = client.post(f"{API}/tests/{test_id}/steps", json={"label": name, "channels": {name[:100]: 1.0}})
        assert step.status_code == 201, (name, step.text)
        assert client.get(f"{API}/tests/{test_id}/steps/0").json()["label"] == name
        files = {cam: (f"{name[:50]}.tif", content) for cam, content in pair.items()}
        sent = client.post(f"{API}/tests/{test_id}/steps:import", files=files, data={"label": name})
        assert sent.status_code == 201, (name, sent.text)
        assert sent.json()["label"] == name
        document = json.loads((root / "tests" / test_id / "test.json").read_text(encoding="utf-8"))
        assert document["name"] == name
        steps = {"0000", "0001"} & {p.name for p in (root / "tests" / test_id / "steps").iterdir()}
        assert {p.name for p in (root / "tests" / test_id).rglob("*")} == {
            *("test.json", "manifest.json", "steps", "analyses", "step.json", "cam1.tif", "cam2.tif"),
            *steps,
        }
    labelled = client.post(f"{API}/noise", json={"label": NAMES[0], "frames": 2})
    assert wait_for_job(client, labelled.json()["job"])["state"] in ("succeeded", "failed")
    assert client.get(f"{API}/noise/{labelled.json()['noise_id']}").json()["plan"]["label"] == NAMES[0]
    assert sorted(p.name for p in root.parent.iterdir()) == outside
    assert verify(root).findings == ()


@pytest.mark.fault(9)
@pytest.mark.fault(48)
@pytest.mark.parametrize(
    "raw",
    [
        *('"' + "x" * 301 + '"', '"\\ud800"', '"\\udfff\\ud800"', "7", "null", "[]"),
        *('"two\\nlines"', '"a\\u0000b"', '"\\u202eright to left"'),
    ],
)
def test_what_is_no_label_is_refused(client: httpx.Client, raw: str) -> None:
    headers = {"Content-Type": "application/json"}
    made = client.post(f"{API}/tests", json={"name": "a test"}).json()["id"]
    for url, body in (("/tests", f'{{"name": {raw}}}'), (f"/tests/{made}/steps", f'{{"label": {raw}}}')):
        answer = client.post(f"{API}{url}", content=body.encode(), headers=headers)
        assert_problem(answer, 422, "invalid_request")
    assert client.get(f"{API}/tests/{made}").json()["steps"] == []


# clocks ---------------------------------------------------------------------------------------------------------


class Jumping(datetime):
    """A wall clock that can be set."""

    ahead = timedelta(0)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
        return datetime.now(tz) + cls.ahead


@pytest.mark.fault(7)
def test_order_stands_when_the_clock_steps_back_and_forward(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stereorig.server.store.folder, "datetime", Jumping)
    service = Service(tiny_config(), tmp_path / "data").start()
    jumps = [0, -3600, 86400 * 365 * 10, -86400 * 365 * 40, 1, 0]
    tests: list[str] = []
    try:
        with served(service) as client:
            wait_for_rig(client)
            test_id = client.post(f"{API}/tests", json={"name": "clock"}).json()["id"]
            steps: list[dict[str, Any]] = []
            for k, jump in enumerate(jumps):
                Jumping.ahead = timedelta(seconds=jump)
                answer = client.post(f"{API}/tests/{test_id}/steps", json={"label": f"{k}"})
                assert answer.status_code == 201
                steps.append(answer.json())
                tests.append(client.post(f"{API}/tests", json={"name": f"{k}"}).json()["id"])
                moved = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.1 * (k % 2)}}).json()
                job = wait_for_job(client, moved["job"])
                assert job["state"] == "succeeded"
            listed = client.get(f"{API}/tests/{test_id}").json()["steps"]
            assert [s["label"] for s in listed] == [f"{k}" for k in range(len(jumps))]
            monotonic = [s["host_monotonic_ns"] for s in steps]
            assert monotonic == sorted(monotonic)
            assert all(s["skew_ms"] is not None and s["skew_ms"] <= 1.0 for s in steps)
            years = {datetime.fromisoformat(s["captured_utc"]).year for s in steps}
            assert len(years) == 3, "the wall clock is told as it was"
            jobs = client.get(f"{API}/jobs").json()["jobs"]
            assert [j["id"] for j in jobs] == sorted((j["id"] for j in jobs), reverse=True)
    finally:
        service.close()
    # a service that starts while the clock is in the past goes on where it was
    Jumping.ahead = timedelta(days=-20000)
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            assert [t["id"] for t in client.get(f"{API}/tests").json()["tests"]] == [test_id, *tests]
            assert client.post(f"{API}/tests/{test_id}/steps", json={}).json()["n"] == len(jumps)
            newest = client.post(f"{API}/tests", json={"name": "newest"}).json()["id"]
            assert client.get(f"{API}/tests").json()["tests"][-1]["id"] == newest
    finally:
        service.close()
        Jumping.ahead = timedelta(0)


# versions -------------------------------------------------------------------------------------------------------


@pytest.mark.fault(10)
@pytest.mark.parametrize("content", [None, '{"format": 0}', '{"format": 1, "written_by": "stereorig 0.0"}'])
def test_a_folder_of_an_older_format_opens(tmp_path: Path, content: str | None) -> None:
    DataFolder(tmp_path / "data").open().close()
    path = tmp_path / "data" / "format.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    DataFolder(tmp_path / "data").open().close()
    assert verify(tmp_path / "data").sound


@pytest.mark.fault(10)
@pytest.mark.parametrize("content", ['{"format": 3}', '{"format": "new"}', "{}", '{"format": 1e9}', '{"format": true}'])
def test_a_folder_of_a_newer_format_is_refused_by_every_command(tmp_path: Path, content: str) -> None:
    DataFolder(tmp_path / "data").open().close()
    (tmp_path / "data" / "format.json").write_text(content)
    with pytest.raises(FileFormatError) as caught:
        DataFolder(tmp_path / "data").open()
    assert caught.value.code == "data_format_newer"
    with pytest.raises(FileFormatError):
        verify(tmp_path / "data")
    if "3" not in content:
        return
    command = [sys.executable, "-m", "stereorig.server.cli", "serve", "--port", "0", "--data", str(tmp_path / "data")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "data_format_newer" in done.stderr
    assert "newer" in done.stderr
