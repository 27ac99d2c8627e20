"""A reference extensometer's record beside a certificate: in agreement, off by 1 %, in another unit, without one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.formats.images import encode_tiff
from stereorig.server.workflows.service import Service
from tests.support.model_bench import write_result
from tests.support.service_rig import served, tiny_config, true_cameras, wait_for_job
from tests.support.strain_fields import make_field
from tests.support.tiny_rig import TINY

API = "/api/v1"
TEST, ANALYSIS = "t000003-abcdef", "a000003-abcdef"
STATIC, LOADED = (1, 2, 3), tuple(range(4, 15))
ENDS = {"a_px": [150.0, 230.0], "b_px": [350.0, 230.0]}
LENGTH0_MM = 200.0 * 0.033
BEGAN = datetime(2026, 3, 1, 12, tzinfo=UTC)


def strain_of(n: int) -> float:
    """Up to 6 %: 0.4 mm of elongation, where percents count more than micrometres."""
    return 0.006 * max(n - 3, 0)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service on a test whose results are drawn: a plane that is stretched along X by a known strain."""
    data = tmp_path_factory.mktemp("extensometer") / "data"
    home = data / "tests" / TEST
    results = home / "analyses" / ANALYSIS
    results.mkdir(parents=True)
    (home / "calibration.json").write_text(json.dumps(true_cameras(TINY)))
    picture = encode_tiff(np.random.default_rng(1).integers(0, 255, (144, 160)).astype(np.uint8))
    images = dict.fromkeys(("cam1", "cam2"), hashlib.sha256(picture).hexdigest())
    calibration = hashlib.sha256((home / "calibration.json").read_bytes()).hexdigest()
    inputs = {**images, **{f"reference_{cam}": known for cam, known in images.items()}, "calibration": calibration}
    for n in (0, *STATIC, *LOADED):
        stretch = np.array([1.0 + strain_of(n), 1.0, 1.0])
        if n > 0:
            field = make_field(lambda a, b: np.stack([a, b, 0.0 * a], axis=-1), lambda x, by=stretch: x * by)  # type: ignore[misc]
            write_result(results, field, n=n, strain_window=None, inputs=inputs)
        folder = home / "steps" / f"{n:04d}"
        folder.mkdir(parents=True)
        for cam in images:
            (folder / f"{cam}.tif").write_bytes(picture)
        stamp = (BEGAN + timedelta(seconds=10 * n)).isoformat()
        step = {"n": n, "test_id": TEST, "label": "", "source": "import", "timestamp_utc": stamp, "sha256": images}
        (folder / "step.json").write_text(json.dumps(step))
    steps = [*STATIC, *LOADED]
    made = {"id": ANALYSIS, "test_id": TEST, "kind": "displacement", "steps": [0, *steps], "settings": {}}
    (results / "analysis.json").write_text(json.dumps({**made, "created_utc": BEGAN.isoformat()}))
    document = {"id": TEST, "name": "tension", "calibration_id": None, "created_utc": BEGAN.isoformat()}
    (home / "test.json").write_text(json.dumps(document))
    service = Service(tiny_config(), data).start()
    try:
        with served(service) as client:
            yield client
    finally:
        service.close()


def record(client: httpx.Client, title: str, factor: float = 1.0) -> str:
    """Import the reference's record, its elongations times a factor; return the channel's name."""
    rows = [f"{10 * n},{factor * strain_of(n) * LENGTH0_MM:.9f}" for n in (0, *STATIC, *LOADED)]
    content = "\n".join([f"Time (s),{title}", *rows]).encode()
    sent = {"starts_utc": BEGAN.isoformat(), "replace": "true", "max_gap_s": "60"}
    answer = client.post(f"{API}/tests/{TEST}/channels:import", files={"file": ("e.csv", content)}, data=sent)
    assert answer.is_success, answer.text
    (name,) = answer.json()["channels"]
    return str(name)


def certified(client: httpx.Client, channel: str, wanted: str = "0.5") -> dict[str, Any]:
    """Make a certificate of the extensometer alone; return its job as it ended."""
    reference = {**ENDS, "channel": channel, "u_mm": 1e-5, "gauge_length_mm": LENGTH0_MM}
    few = {"translations": 0, "lengths": 0, "rotations": 0}
    plan = {"static_steps": [*STATIC], "extensometer": reference, "limits": {"extensometer_class": wanted, **few}}
    answer = client.post(f"{API}/certificates", json={"test_id": TEST, "analysis_id": ANALYSIS, "plan": plan})
    assert answer.status_code == 202, answer.text
    return wait_for_job(client, answer.json()["job"])


def reached(client: httpx.Client, done: dict[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """The extensometer's table of a certificate, and the codes of its reasons."""
    assert done["state"] == "succeeded", done["problem"]
    shown = client.get(f"{API}/certificates/{done['result']['certificate_id']}").json()
    return shown["extensometer"], {one["code"] for one in shown["reasons"]}


def test_a_record_that_agrees_reaches_the_class(client: httpx.Client) -> None:
    found, reasons = reached(client, certified(client, record(client, "Reference (mm)")))
    assert found["reached"] == "0.2"
    assert len(found["rows"]) == len(LOADED)
    assert not reasons & {"extensometer_class", "extensometer_reference", "error_beyond_uncertainty"}
    # interpolation and float32 files leave no more than 10 nm of 0.4 mm
    assert max(abs(row["error_mm"]) for row in found["rows"]) < 1e-5
    assert found["rows"][-1]["true_mm"] == pytest.approx(strain_of(LOADED[-1]) * LENGTH0_MM, abs=1e-8)


def test_a_record_in_another_unit_is_the_same_record(client: httpx.Client) -> None:
    name = record(client, "Micron reading (µm)", 1e3)
    assert name.endswith("_um")
    found, _ = reached(client, certified(client, name))
    assert found["reached"] == "0.2"
    assert found["rows"][-1]["true_mm"] == pytest.approx(strain_of(LOADED[-1]) * LENGTH0_MM, abs=1e-8)


def test_a_record_that_is_off_by_1_percent_costs_the_class_and_is_named(client: httpx.Client) -> None:
    name = record(client, "Scale off (mm)", 1.01)
    done = certified(client, name)
    found, reasons = reached(client, done)
    assert done["result"]["outcome"] == "fail"
    assert found["reached"] == "1"  # 1 less 1 / 1.01 is 0.99 %
    assert "extensometer_class" in reasons
    assert "error_beyond_uncertainty" in reasons
    assert found["rows"][-1]["relative"] == pytest.approx(1.0 / 1.01 - 1.0, rel=1e-3)
    assert "extensometer_class" not in reached(client, certified(client, name, "1"))[1]


@pytest.mark.parametrize("title", ["Without unit", "Inches (in)", "Force (kN)"])
def test_a_record_without_a_unit_of_length_is_refused_and_nothing_is_kept(client: httpx.Client, title: str) -> None:
    before = client.get(f"{API}/certificates").json()["certificates"]
    done = certified(client, record(client, title))
    assert (done["state"], done["problem"]["code"]) == ("failed", "certificate_channel_unit")
    assert "_mm" in done["problem"]["remedy"]
    assert client.get(f"{API}/certificates").json()["certificates"] == before


def test_a_channel_that_no_step_has_is_told(client: httpx.Client) -> None:
    done = certified(client, "elsewhere_mm")
    assert (done["state"], done["problem"]["code"]) == ("failed", "certificate_step_missing")
