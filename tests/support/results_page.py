"""The page's results screen on a measured plate."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from stereorig.core.field.region.cuts import Cuts
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.store.indexing.entries import analysis_entry
from stereorig.server.workflows.service import Service
from tests.support.page_bench import Watched, undrawn, watched
from tests.support.service_rig import SMALL, served, wait_for_job, wait_for_rig

RECTANGLE = [60, 60, 180, 170]


@dataclass
class Bench:
    """A measured plate, and the same with points missing and a cut."""

    service: Service
    client: httpx.Client
    test_id: str
    analysis_id: str
    cut_id: str

    def path(self, analysis_id: str | None = None) -> str:
        return f"{API}/tests/{self.test_id}/analyses/{analysis_id or self.analysis_id}"

    def field(self, step: int, name: str, analysis_id: str | None = None, frame: str = "specimen") -> Any:
        """A variable in the axes that the page shows by default."""
        answer = self.client.get(f"{self.path(analysis_id)}/steps/{step}/fields/{name}", params={"frame": frame})
        assert answer.status_code == 200, answer.text
        return np.array(answer.json()["values"], dtype=float)


def capture_plate(client: httpx.Client, name: str) -> tuple[str, str]:
    """Calibrate, and capture the plate under three pressures; return the ids of calibration and test."""
    wait_for_rig(client)
    accepted = client.post(f"{API}/calibrations", json={"positions_mm": [0, 5], "held_out_mm": [2], "frames": 2}).json()
    assert wait_for_job(client, accepted["job"])["state"] == "succeeded"
    calibration_id = str(accepted["calibration_id"])
    test_id = str(client.post(f"{API}/tests", json={"name": name, "calibration_id": calibration_id}).json()["id"])
    for pressure in (0.0, 344.5, 689.0):
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": pressure})
        step = {"label": f"{pressure} kPa", "load_n": 2 * pressure, "channels": {"stroke_mm": pressure / 100}}
        assert client.post(f"{API}/tests/{test_id}/steps", json=step).status_code == 201
    return calibration_id, test_id


def make_plate(data: Path) -> dict[str, str]:
    """Calibrate, capture the plate under three pressures and measure it; return the ids of test and analysis."""
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            _, test_id = capture_plate(client, "plate <b>&")
            asked = {"region": {"rectangle": RECTANGLE}, "subset_px": 25, "spacing_px": 10, "strain": {"window": 5}}
            made = client.post(f"{API}/tests/{test_id}/analyses", json=asked).json()
            assert wait_for_job(client, made["job"])["state"] == "succeeded"
    finally:
        service.close()
    return {"test_id": test_id, "analysis_id": str(made["analysis_id"])}


def plate_data(shared: Path, copy: Path) -> dict[str, str]:
    """Copy a data folder with the measured plate, made once in a run: whichever worker comes first makes it."""
    shared.mkdir(parents=True, exist_ok=True)
    found = shared / "ids.json"
    with (shared / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not found.exists():
            shutil.rmtree(shared / "data", ignore_errors=True)
            found.write_text(json.dumps(make_plate(shared / "data")))
    shutil.copytree(shared / "data", copy)
    ids: dict[str, str] = json.loads(found.read_text())
    return ids


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    base = tmp_path_factory.getbasetemp()
    data = tmp_path_factory.mktemp("results") / "data"
    ids = plate_data((base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base) / "plate", data)
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 689.0}).raise_for_status()
            test_id, analysis_id = ids["test_id"], ids["analysis_id"]
            yield Bench(service, client, test_id, analysis_id, with_a_cut(service, test_id, analysis_id))
    finally:
        service.close()


VERTICAL = ((155.0, 50.0), (155.0, 120.0))


def with_a_cut(service: Service, test_id: str, analysis_id: str, line: Sequence[tuple[float, float]] = VERTICAL) -> str:
    """The plate's results with three points missing, a cut (between two columns), and 1 um more deflection."""
    whole = service.tests.analyses.path(test_id, analysis_id)
    stored = service.tests.analyses.read(test_id, analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "steps", "inputs", "software")}
    document = service.tests.analyses.create(test_id, {**kept, "label": "with a cut"})
    service.catalog.put_entry("analysis", test_id, document.id, analysis_entry(document))
    folder = service.tests.analyses.path(test_id, document.id)
    for n in stored["steps"]:
        field = read_field(whole / f"step_{n:04d}.nc")
        field.status[4, 5] = field.status[4, 6] = field.status[8, 2] = 6
        object.__setattr__(field, "cuts", Cuts([line]))
        if field.uvw_mm is not None:
            field.uvw_mm[..., 2] += 1e-3
        provenance = Provenance({"subset_px": 25, "spacing_px": 10}, {"a": "b"}, "0.1.0", step=n)
        write_field(folder / f"step_{n:04d}.nc", field, provenance)
    return document.id


@pytest.fixture
def page(chromium: Browser, bench: Bench) -> Iterator[Watched]:
    undrawn(bench.client)
    with watched(chromium, str(bench.client.base_url).rstrip("/")) as made:
        yield made


def shown(page: Watched, bench: Bench, *, step: int = 2, name: str = "w_mm", analysis_id: str | None = None) -> Page:
    """Open an analysis and wait until its field is drawn."""
    page.open(f"#/results/{bench.test_id}/{analysis_id or bench.analysis_id}?step={step}&field={name}")
    drawn(page.page, f"{step} {name} reference")
    return page.page


def given(at: Page, names: tuple[str, ...], values: tuple[float, ...]) -> None:
    for name, value in zip(names, values, strict=True):
        at.get_by_label(name, exact=True).fill(str(value))


LINE = ("Line from x", "Line from y", "Line to x", "Line to y")


ENDS = ("Extensometer a x", "Extensometer a y", "Extensometer b x", "Extensometer b y")


API = "/api/v1"


def drawn(at: Page, what: str) -> None:
    at.wait_for_selector(f'canvas[data-role="map"][data-shown="{what}"]', state="attached")
    at.wait_for_function("() => document.querySelector('canvas[data-role=map]').width === 256")


def two_digits_of_u(value_mm: float, u_mm: float) -> str:
    """A length as the GUM (7.2.6) has it stated, two digits of u; in micrometres below 0.1 mm."""
    unit, times = ("µm", 1000) if max(abs(value_mm), u_mm) < 0.1 else ("mm", 1)
    value, u = Decimal(value_mm) * times, Decimal(f"{u_mm * times:.1e}")
    text = f"{value.quantize(u)} ± {u:f}\N{NO-BREAK SPACE}{unit}"
    return text.replace("-", "\N{MINUS SIGN}")
