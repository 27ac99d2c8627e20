"""An analysis measured again: equal to the last bit, or how far apart over its uncertainty and what has changed."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import pytest

from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.measured_test import API, measured_test
from tests.support.service_rig import SMALL, served, wait_for_job


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A data folder, and TEST/ANALYSIS in it."""
    data = tmp_path_factory.mktemp("reproduce") / "data"
    return data, "/".join(measured_test(data))


@pytest.fixture
def copied(measured: tuple[Path, str], tmp_path: Path) -> tuple[Path, str]:
    shutil.copytree(measured[0], tmp_path / "data")
    return tmp_path / "data", measured[1]


def reproduced(data: Path, name: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    status = main(["reproduce", name, "--data", str(data), "--json"])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)["repetitions"][0]
    return status, found


def changed(data: Path, name: str, n: int, change: Callable[[Any], None]) -> None:
    """Change a result of an analysis, and its checksum with it, in a folder that never had a manifest."""
    test_id, analysis_id = name.split("/")
    (data / "tests" / test_id / "manifest.json").unlink(missing_ok=True)
    path = data / "tests" / test_id / "analyses" / analysis_id / f"step_{n:04d}.nc"
    with netCDF4.Dataset(path, "a") as dataset:
        dataset.set_auto_mask(False)
        change(dataset)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_name(f"{path.name}.sha256").write_text(f"{digest}  {path.name}\n")


def test_the_same_version_on_the_same_processor_gives_the_same_bits(
    measured: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    data, name = measured
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*")}
    status, found = reproduced(data, name, capsys)
    assert (status, found["verdict"], found["changes"]) == (0, "equal", [])
    assert [(step["n"], step["verdict"]) for step in found["steps"]] == [(0, "equal"), (1, "equal"), (2, "equal")]
    assert {path: path.stat().st_mtime_ns for path in data.rglob("*")} == before  # only read


def test_a_number_off_in_its_last_bits_is_within_and_one_off_by_its_uncertainty_differs(
    copied: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    data, name = copied

    def nudge(dataset: Any) -> None:
        dataset["w_mm"][...] = dataset["w_mm"][...] + 1e-12

    changed(data, name, 1, nudge)
    status, found = reproduced(data, name, capsys)
    step = found["steps"][1]
    assert (status, found["verdict"], step["verdict"]) == (0, "within", "within")
    (one,) = step["differences"]
    assert one["name"] == "w_mm"
    assert one["largest"] == pytest.approx(1e-12, rel=1e-3)
    assert 0.0 < one["over_u"] < 1e-6

    def shift(dataset: Any) -> None:
        dataset["w_mm"][...] = dataset["w_mm"][...] + 0.5 * dataset["sigma_w_mm"][...]

    changed(data, name, 2, shift)
    status, found = reproduced(data, name, capsys)
    assert (status, found["verdict"], found["steps"][2]["verdict"]) == (1, "differs", "differs")
    assert found["steps"][2]["differences"][0]["over_u"] == pytest.approx(0.5, abs=0.01)


def test_a_point_with_another_status_differs(copied: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    data, name = copied

    def fail(dataset: Any) -> None:
        dataset["status"][2, 3] = 5

    changed(data, name, 1, fail)
    status, found = reproduced(data, name, capsys)
    assert (status, found["steps"][1]["status_changed"]) == (1, 1)


def test_what_has_changed_since_is_named(copied: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    data, name = copied

    def elsewhere(dataset: Any) -> None:
        known = json.loads(dataset.environment)
        known["libraries"]["numpy"] = "1.26.0"
        known |= {"processor": "another one", "software_version": "0.1.0"}
        dataset.environment = json.dumps(known)

    for n in range(3):
        changed(data, name, n, elsewhere)
    status, found = reproduced(data, name, capsys)
    assert (status, found["verdict"]) == (0, "equal")
    assert {(one["what"], one["before"]) for one in found["changes"]} == {
        ("version", "0.1.0"),
        ("processor", "another one"),
        ("numpy", "1.26.0"),
    }


def test_a_result_from_before_environments_were_kept_says_so(
    copied: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    data, name = copied
    for n in range(3):
        changed(data, name, n, lambda dataset: dataset.delncattr("environment"))
    status, found = reproduced(data, name, capsys)
    assert (status, found["verdict"], [one["what"] for one in found["changes"]]) == (0, "equal", ["environment"])


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        ("steps/0001/cam2.tif", "checksum_mismatch"),
        ("calibration.json", "checksum_mismatch"),
        ("analyses/*/step_0001.nc", "checksum_mismatch"),
    ],
)
def test_inputs_that_are_not_as_they_were_are_named(
    copied: tuple[Path, str], capsys: pytest.CaptureFixture[str], spoil: str, code: str
) -> None:
    data, name = copied
    (path,) = (data / "tests" / name.split("/")[0]).glob(spoil)
    path.write_bytes(path.read_bytes()[:-1] + b" ")
    assert main(["reproduce", name, "--data", str(data)]) == 1
    assert capsys.readouterr().err.startswith(f"stereorig: {code}: ")


@pytest.mark.parametrize("name", ["t000009-ffffff/a000001-ffffff", "../etc/passwd", "t000009-ffffff"])
def test_an_unknown_name_is_refused(measured: tuple[Path, str], capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main(["reproduce", name, "--data", str(measured[0])]) == 1
    assert capsys.readouterr().err.startswith("stereorig: not_found: ")


def test_the_service_does_it_as_a_job(copied: tuple[Path, str]) -> None:
    data, name = copied
    test_id, analysis_id = name.split("/")
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            sent = client.post(f"{API}/tests/{test_id}/analyses/{analysis_id}:reproduce")
            assert sent.status_code == 202
            done = wait_for_job(client, sent.json()["job"])
            assert (done["state"], done["kind"]) == ("succeeded", "repetition")
            assert done["result"]["verdict"] == "equal"
            assert [step["n"] for step in done["result"]["steps"]] == [0, 1, 2]
            assert [path for path in (data / ".exports").glob("*") if path.name != "kept"] == []
            gone = client.post(f"{API}/tests/{test_id}/analyses/a000099-ffffff:reproduce")
            assert (gone.status_code, gone.json()["code"]) == (404, "not_found")
    finally:
        service.close()
