"""Each door gives a test's strain along the specimen's axes, and says so; the system frame where it is asked for."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import stereorig
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.cli import main
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.workflows.service import Service
from tests.support.gauge_field import SUBSET, make_field
from tests.support.tension import LATERAL, TENSION, pulled, shape

# as in test_specimen_frame.py: the file's float32 numbers
TOLERANCE = 3e-6
TURNED = 0.5 * (TENSION + LATERAL)  # exx and eyy alike along axes at 45 degrees to the tension
SPECIMEN, SYSTEM = "aligned by plane, X along camera 1's image rows", "sys"


@pytest.fixture(scope="module")
def folder(service: Service) -> Path:
    """An analysis whose second step is a tension along the image's vertical."""
    test = service.tests.create({"name": "Strip", "specimen": "", "notes": ""}, None)
    document = {"kind": "displacement", "steps": [0, 1], "settings": {}, "inputs": {"steps": {"0": {}}}}
    path = Path(service.tests.analyses.path(test.id, service.tests.analyses.create(test.id, document).id))
    for n, motion in enumerate((None, pulled)):
        field = make_field(motion, shape=shape)
        strain = None if motion is None else surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
        given = Provenance(
            {"subset_px": SUBSET, "region": {}}, {"calibration": "aa", "reference_cam1": "bb"}, "1", step=n
        )
        write_field(path / f"step_{n:04d}.nc", field, given, strain)
    return path


@pytest.fixture(scope="module")
def url(folder: Path) -> str:
    return f"/api/v1/tests/{folder.parent.parent.name}/analyses/{folder.name}"


@pytest.fixture(scope="module")
def analysis(client: httpx.Client, folder: Path) -> Iterator[stereorig.client.Analysis]:
    with stereorig.Client(str(client.base_url), progress=False) as made:
        yield made.test(folder.parent.parent.name).analysis(folder.name)


def strain_in(table: str) -> tuple[float, float]:
    """Mean of exx and eyy of a table of points."""
    rows = list(csv.DictReader(line for line in io.StringIO(table) if not line.startswith("#")))
    exx, eyy = (np.array([float(row[name]) for row in rows if row[name]]) for name in ("exx", "eyy"))
    return float(exx.mean()), float(eyy.mean())


@pytest.mark.parametrize(
    ("asked", "named", "exx", "eyy"),
    [(None, SPECIMEN, LATERAL, TENSION), ("specimen", SPECIMEN, LATERAL, TENSION), ("system", SYSTEM, TURNED, TURNED)],
    ids=["by default", "specimen", "system"],
)
def test_every_door_gives_the_same_strain_and_names_its_axes(
    client: httpx.Client,
    folder: Path,
    url: str,
    analysis: stereorig.client.Analysis,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    asked: str | None,
    named: str,
    exx: float,
    eyy: float,
) -> None:
    want = pytest.approx(eyy, abs=TOLERANCE if named == SPECIMEN else 5e-6)
    where: dict[str, Any] = {} if asked is None else {"frame": asked}

    def get(path: str, **params: Any) -> Any:
        return client.get(f"{url}{path}", params={**where, **params}).raise_for_status().json()

    field = get("/steps/1/fields/eyy")
    assert np.nanmean(np.array(field["values"], dtype=float)) == want
    assert field["frame"].startswith(named)
    assert get("/steps/1/fields")["frame"].startswith(named)
    probe = get("/probe", x_px=90, y_px=100, step=1)
    assert (probe["values"]["eyy"]["value"], probe["frame"][: len(named)]) == (want, named)
    course = get("/history/eyy", x_px=90, y_px=100)
    assert (course["value"][-1], course["frame"][: len(named)]) == (want, named)
    # one step alone, whose own shape would define another frame
    body = {"areas": [{"name": "all"}], "variables": ["eyy"], "steps": [1]}
    gauges = client.post(f"{url}/gauges", json=body, params=where).raise_for_status().json()
    assert gauges["steps"][0]["areas"][0]["values"]["eyy"]["mean"] == want
    assert gauges["frame"].startswith(named)
    table = client.get(f"{url}/export", params={**where, "format": "csv", "step": 1}).raise_for_status().text
    assert strain_in(table) == (pytest.approx(exx, abs=5e-6), want)
    assert f"frame: {named}" in table
    report = client.get(f"{url}/report", params=where).raise_for_status().text
    assert named.replace("'", "&#39;") in report
    # the client
    array, data = analysis.field("eyy", 1, **where), analysis.dataset(1, **where)
    assert (float(array.mean()), float(data["eyy"].mean())) == (want, want)
    assert array.attrs["frame"].startswith(named)
    assert data["eyy"].attrs["frame"].startswith(named)
    assert data.attrs["frame"].startswith(named)
    assert "frame" not in data["x_px"].attrs
    read = analysis.gauges(areas=[{"name": "all"}], variables=["eyy"], **where)
    assert read.steps[1].areas[0].values["eyy"].mean == want
    assert read.frame.startswith(named)
    # the library
    result = stereorig.read_result(folder / "step_0001.nc", **where)
    assert float(np.nanmean(result["eyy"])) == want
    assert result.frame.startswith(named)
    assert result.dataset["eyy"].attrs["frame"].startswith(named)
    # the command line
    option = [] if asked is None else ["--frame", asked]
    out = tmp_path / "gauges.json"
    area = ["--area", "all=all", "--variable", "eyy", "--step", "1"]
    assert main(["gauge", str(folder), *area, *option, "--out", str(out)]) == 0
    printed = json.loads(out.read_text())
    assert printed["steps"][0]["areas"][0]["values"]["eyy"]["mean"] == want
    assert f"frame: {named}" in capfd.readouterr().out
    assert main(["export", str(folder), "--format", "csv", "--out", str(tmp_path), "--step", "1", *option]) == 0
    (csv_file,) = tmp_path.glob("*.csv")
    assert strain_in(csv_file.read_text())[1] == want
    assert main(["report", str(folder), *option, "--out", str(tmp_path / "r.html")]) == 0
    assert named.replace("'", "&#39;") in (tmp_path / "r.html").read_text()


def test_a_field_without_its_rigid_motion_is_along_the_specimens_axes(client: httpx.Client, url: str) -> None:
    sent = {"params": {"step": 1}, "json": {"remove_rigid": {}}}
    content = client.post(f"{url}/gauges/field", **sent).raise_for_status().content  # type: ignore[arg-type]
    assert b"aligned by plane" in content
    twice = {"params": {"step": 1, "frame": "system"}, "json": {"align": {"kind": "plane"}}}
    refused = client.post(f"{url}/gauges/field", **twice)  # type: ignore[arg-type]
    assert (refused.status_code, refused.json()["code"]) == (422, "option_conflict")


def test_a_file_that_was_written_in_a_frame_stays_in_it(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "tests" / "t" / "analyses" / "a"
    frame = json.dumps({"kind": "given", "rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]})
    area = ["--area", "all", "--frame", frame, "--field-out", str(out)]
    assert main(["gauge", str(folder), *area]) == 0
    (tmp_path / "tests" / "t" / "test.json").write_text(json.dumps({"id": "t", "name": "one"}))
    assert stereorig.read_result(out / "step_0001.nc").frame.startswith("aligned by given axes; before: sys")


def test_results_without_a_test_stay_as_they_are(folder: Path, tmp_path: Path) -> None:
    alone = tmp_path / "step_0001.nc"
    alone.write_bytes((folder / "step_0001.nc").read_bytes())
    result = stereorig.read_result(alone)
    assert result.frame.startswith(SYSTEM)
    assert float(np.nanmean(result["eyy"])) == pytest.approx(TURNED, abs=5e-6)
