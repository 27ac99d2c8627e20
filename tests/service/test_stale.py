"""FAULTS 42: steps missing, reference missing or replaced, other calibration: refused, or the result marked stale.

A test's folder is taken by the service and put together by hand; files vanish or are replaced after the capture, and
after a measurement.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.core.names import CAMERAS
from stereorig.server.cli import main
from stereorig.server.cli.measurement.measure import SOME_FAILED
from stereorig.server.formats.images import write_image
from stereorig.server.workflows.analysis import start as analysis_start
from stereorig.server.workflows.analysis.tasks import task_of
from stereorig.server.workflows.service import Service
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from tests.support.measure_command import rig as rig
from tests.support.service_rig import wait_for_job

pytestmark = pytest.mark.fault(42)
LOADS = (0.0, 0.4, 0.7, 1.0)
ARGUMENTS = ["--roi", "60,60,120,110", "--subset", "21", "--strain", "off"]


def commit(folder: Path) -> None:
    """Write a step's record, last, as the service does."""
    sha256 = {cam: hashlib.sha256((folder / f"{cam}.tif").read_bytes()).hexdigest() for cam in CAMERAS}
    record = {"n": int(folder.name), "label": "", "load_n": None, "source": "import", "sha256": sha256}
    (folder / "step.json").write_text(json.dumps(record))


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory, rig: SimRig) -> Path:
    """A test's folder as a service leaves it: four steps and the calibration that it was made with."""
    test = tmp_path_factory.mktemp("stale") / "t000001-abcdef"
    rng = np.random.default_rng(3)
    for n, load in enumerate(LOADS):
        step = test / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        scene = make_scene(rig, "block", load=load)
        for name in CAMERAS:
            sim = rig.camera(name)
            seen = render(scene, sim.camera, sim.size_px, options=RenderOptions(blur_px=rig.blur_px, threads=1))
            write_image(step / f"{name}.tif", sim.sensor.expose(sim.lighting.apply(seen), rng, exposure=1.0))
        commit(step)
    calibration = json.dumps({name: rig.camera(name).camera.paper_parameters() for name in CAMERAS})
    (test / "calibration.json").write_text(calibration)
    record = {"id": test.name, "calibration_sha256": hashlib.sha256(calibration.encode()).hexdigest()}
    (test / "test.json").write_text(json.dumps(record))
    return test


@pytest.fixture(scope="module")
def measured(taken: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    test = tmp_path_factory.mktemp("measured") / taken.name
    shutil.copytree(taken, test)
    assert main(["measure", str(test), *ARGUMENTS]) == 0
    return test


def spoil(test: Path, what: str) -> None:
    steps = test / "steps"
    if what == "a step is gone":
        shutil.rmtree(steps / "0002")
    elif what == "the reference is gone":
        shutil.rmtree(steps / "0000")
    elif what == "the reference's image is gone":
        (steps / "0000" / "cam1.tif").unlink()
    elif what == "the reference's image was replaced":
        shutil.copy2(steps / "0003" / "cam1.tif", steps / "0000" / "cam1.tif")
    elif what == "a step's image was replaced":
        shutil.copy2(steps / "0003" / "cam2.tif", steps / "0002" / "cam2.tif")
    elif what == "a step was taken again":
        shutil.copy2(steps / "0003" / "cam2.tif", steps / "0002" / "cam2.tif")
        commit(steps / "0002")
    elif what == "the reference was taken again":
        for cam in CAMERAS:
            shutil.copy2(steps / "0001" / f"{cam}.tif", steps / "0000" / f"{cam}.tif")
        commit(steps / "0000")
    elif what == "the calibration was replaced":
        path = test / "calibration.json"
        path.write_text(path.read_text().replace('"phd_px": ', '"phd_px": 1'))
    elif what == "the calibration is gone":
        (test / "calibration.json").unlink()
    else:
        raise ValueError(what)


REFUSED = {
    "a step is gone": ("step_missing", "Step 2"),
    "the reference is gone": ("reference_missing", "step 0"),
    "the reference's image is gone": ("file_missing", "cam1.tif"),
    "the reference's image was replaced": ("checksum_mismatch", "cam1.tif"),
    "the calibration was replaced": ("calibration_changed", "calibration.json"),
    "the calibration is gone": ("file_missing", "calibration.json"),
}
STALE = {
    "a step is gone": "step 2 is gone",
    "the reference is gone": "the reference, step 0, is gone",
    "the reference's image is gone": "cam1 of the reference, step 0, is gone",
    "the reference's image was replaced": "cam1 of the reference, step 0, was replaced",
    "a step's image was replaced": "cam2 of step 2 was replaced",
    "a step was taken again": "cam2 of step 2 was replaced",
    "the reference was taken again": "cam1 of the reference, step 0, was replaced",
    "the calibration was replaced": "calibration.json was replaced",
    "the calibration is gone": "calibration.json is gone",
}


@pytest.mark.parametrize("what", list(REFUSED))
def test_a_spoiled_test_is_not_measured(taken: Path, tmp_path: Path, capfd: Any, what: str) -> None:
    """FAULTS 42."""
    test = tmp_path / taken.name
    shutil.copytree(taken, test)
    spoil(test, what)
    code, word = REFUSED[what]
    assert main(["measure", str(test), *ARGUMENTS]) != 0
    printed = capfd.readouterr().err
    assert f"stereorig: {code}: " in printed
    assert word in printed
    assert not (test / "exports").exists()


def test_a_step_whose_image_was_replaced_fails_alone(taken: Path, tmp_path: Path, capfd: Any) -> None:
    """FAULTS 4, 42."""
    test = tmp_path / taken.name
    shutil.copytree(taken, test)
    spoil(test, "a step's image was replaced")
    assert main(["measure", str(test), *ARGUMENTS]) == SOME_FAILED
    assert "step 2 of 3: failed: checksum_mismatch: " in capfd.readouterr().err
    summary = json.loads((test / "exports" / "measure" / "summary.json").read_text())
    assert [step["n"] for step in summary["steps"]] == [0, 1, 3]
    assert "cam2.tif" in summary["steps_failed"]["2"]["detail"]


def gauges(where: Path, out: Path) -> dict[str, Any]:
    assert main(["gauge", str(where), "--area", "all", "--out", str(out)]) == 0
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def test_an_untouched_measurement_is_not_stale(measured: Path, tmp_path: Path, capfd: Any) -> None:
    """FAULTS 42: nor is a copy, whose files all have new times."""
    copy = tmp_path / measured.name
    shutil.copytree(measured, copy)
    for where in (measured, copy, copy / "exports" / "measure"):
        document = gauges(where, tmp_path / "g.json")
        assert document["stale"] is False
        assert document["stale_reasons"] == []
        assert "STALE" not in capfd.readouterr().out


@pytest.mark.parametrize("what", list(STALE))
def test_gauges_of_a_measurement_whose_inputs_changed_are_marked(
    measured: Path, tmp_path: Path, capfd: Any, what: str
) -> None:
    """FAULTS 42."""
    test = tmp_path / measured.name
    shutil.copytree(measured, test)
    spoil(test, what)
    document = gauges(test, tmp_path / "g.json")
    assert document["stale"] is True
    assert STALE[what] in document["stale_reasons"]
    assert f"STALE: {STALE[what]}" in capfd.readouterr().out
    assert len(document["steps"]) == 4  # what was measured can still be read


def test_a_missing_result_is_told(measured: Path, tmp_path: Path) -> None:
    """FAULTS 42."""
    test = tmp_path / measured.name
    shutil.copytree(measured, test)
    (test / "exports" / "measure" / "step_0001.nc").unlink()
    document = gauges(test, tmp_path / "g.json")
    assert document["stale_reasons"] == ["the result of step 1 is gone"]
    assert 'stale_reasons: ["the result of step 1 is gone"]' in _csv(test, tmp_path)


def _csv(test: Path, tmp_path: Path) -> str:
    assert main(["gauge", str(test), "--area", "all", "--out", str(tmp_path / "g.csv")]) == 0
    return (tmp_path / "g.csv").read_text()


# over HTTP

API = "/api/v1"
BODY = {"region": {"rectangle": [60, 60, 120, 110]}, "subset_px": 21, "strain": None}
REFUSED_BY_SERVICE = {
    "a step is gone": (422, "step_missing"),
    "the reference is gone": (409, "no_steps"),
    "the calibration was replaced": (422, "calibration_changed"),
    "the calibration is gone": (409, "not_calibrated"),
}


def copied_in(test: Path, service: Service) -> tuple[str, Path]:
    """A folder copied by hand from elsewhere is a valid test."""
    name = service.folder.ids.new("t")
    test_folder = service.folder.tests / name
    shutil.copytree(test, test_folder, ignore=shutil.ignore_patterns("manifest.json", "manifest"))
    (test_folder / "analyses").mkdir(exist_ok=True)
    record = json.loads((test_folder / "test.json").read_text())
    (test_folder / "test.json").write_text(json.dumps({**record, "id": name, "name": "a plate"}))
    for mark in test_folder.glob("steps/*/step.json"):
        mark.write_text(mark.read_text())  # comes last
    return f"{API}/tests/{name}", test_folder


@pytest.fixture(scope="module")
def analysed(taken: Path, service: Service, client: httpx.Client) -> tuple[Path, str]:
    """A test with a finished analysis, and the analysis' id."""
    url, test_folder = copied_in(taken, service)
    accepted = client.post(f"{url}/analyses", json=BODY)
    assert accepted.status_code == 202, accepted.text
    done = wait_for_job(client, accepted.json()["job"], 240.0)
    assert done["state"] == "succeeded", done
    return test_folder, accepted.json()["analysis_id"]


@pytest.mark.parametrize("what", list(REFUSED_BY_SERVICE))
def test_the_service_refuses_a_spoiled_test(taken: Path, service: Service, client: httpx.Client, what: str) -> None:
    """FAULTS 42."""
    url, test_folder = copied_in(taken, service)
    spoil(test_folder, what)
    answer = client.post(f"{url}/analyses", json=BODY)
    status, code = REFUSED_BY_SERVICE[what]
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert answer.json()["remedy"]


def test_a_replaced_image_of_the_reference_ends_the_job_and_of_a_step_the_step(
    taken: Path, service: Service, client: httpx.Client
) -> None:
    """FAULTS 4, 42."""
    url, test_folder = copied_in(taken, service)
    spoil(test_folder, "the reference's image was replaced")
    done = wait_for_job(client, client.post(f"{url}/analyses", json=BODY).json()["job"], 240.0)
    assert done["state"] == "failed"
    assert done["problem"]["code"] == "checksum_mismatch"
    url, test_folder = copied_in(taken, service)
    spoil(test_folder, "a step's image was replaced")
    done = wait_for_job(client, client.post(f"{url}/analyses", json=BODY).json()["job"], 240.0)
    assert done["state"] == "succeeded", done["problem"]
    assert done["result"]["steps_finished"] == [0, 1, 3]
    assert done["result"]["steps_failed"]["2"]["code"] == "checksum_mismatch"


def test_what_changes_between_asking_and_measuring_is_refused(
    taken: Path, service: Service, client: httpx.Client
) -> None:
    """FAULTS 42: inputs are fixed when an analysis is made; the task of a step finds them as they were."""
    _, test_folder = copied_in(taken, service)
    document = {
        "kind": "displacement",
        "steps": [0, 1],
        "settings": {**BODY, "noise": None},
        "label": "",
        "inputs": analysis_start.inputs_of(service, test_folder.name, [0, 1], test_folder / "calibration.json"),
    }
    made = service.tests.analyses.create(test_folder.name, document)
    spoil(test_folder, "the reference was taken again")
    with pytest.raises(FileFormatError) as caught:
        task_of(service.tests, made, 1, {}, None)
    assert caught.value.code == "checksum_mismatch"
    _, test_folder = copied_in(taken, service)
    made = service.tests.analyses.create(test_folder.name, document)
    spoil(test_folder, "the calibration was replaced")
    with pytest.raises(FileFormatError) as caught:
        task_of(service.tests, made.model_copy(update={"test_id": test_folder.name}), 1, {}, None)
    assert caught.value.code == "checksum_mismatch"


def test_an_untouched_analysis_is_not_stale(analysed: tuple[Path, str], client: httpx.Client) -> None:
    """FAULTS 42."""
    test_folder, analysis = analysed
    url = f"{API}/tests/{test_folder.name}/analyses/{analysis}"
    shown = client.get(url).json()
    assert (shown["stale"], shown["stale_reasons"]) == (False, [])
    assert "x-stale" not in client.get(f"{url}/export", params={"step": 2}).headers
    assert client.post(f"{url}/gauges", json={"areas": [{}]}).json()["stale"] is False


@pytest.mark.parametrize("what", list(STALE))
def test_an_analysis_whose_inputs_changed_is_marked(
    analysed: tuple[Path, str], service: Service, client: httpx.Client, what: str
) -> None:
    """FAULTS 42: in the analysis, with its export and in gauges; what was measured can still be read."""
    test_folder, analysis = analysed
    _, copy = copied_in(test_folder, service)
    spoil(copy, what)
    url = f"{API}/tests/{copy.name}/analyses/{analysis}"
    shown = client.get(url).json()
    assert shown["stale"] is True
    assert STALE[what] in shown["stale_reasons"]
    export = client.get(f"{url}/export", params={"step": 3})
    assert export.status_code == 200
    assert STALE[what] in export.headers["x-stale"]
    read = client.post(f"{url}/gauges", json={"areas": [{}]}).json()
    assert read["stale"] is True
    assert STALE[what] in read["stale_reasons"]


# files elsewhere


def test_results_elsewhere_know_their_calibration_and_images(taken: Path, tmp_path: Path) -> None:
    """FAULTS 42: images that were moved away may well be what they were; replaced ones are not."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    for n in (0, 3):
        for cam in CAMERAS:
            shutil.copy2(taken / "steps" / f"{n:04d}" / f"{cam}.tif", folder / f"{cam}_{n}.tif")
    shutil.copy2(taken / "calibration.json", folder)
    assert (
        main(
            [
                "measure",
                "--cam1",
                str(folder / "cam1_*"),
                "--cam2",
                str(folder / "cam2_*"),
                *ARGUMENTS,
                "--calibration",
                str(folder / "calibration.json"),
                "--out",
                str(out),
            ]
        )
        == 0
    )
    assert gauges(out, tmp_path / "g.json")["stale"] is False
    shutil.copy2(folder / "cam1_0.tif", folder / "cam1_3.tif")
    assert gauges(out, tmp_path / "g.json")["stale_reasons"] == ["cam1 of step 1 was replaced"]
    (folder / "cam1_3.tif").unlink()
    assert gauges(out, tmp_path / "g.json")["stale"] is False
    (folder / "calibration.json").write_text("{}")
    assert gauges(out, tmp_path / "g.json")["stale_reasons"] == ["calibration.json was replaced"]


def test_an_incomplete_step_is_left_out_and_the_others_keep_their_numbers(taken: Path, tmp_path: Path) -> None:
    """FAULTS 42."""
    test = tmp_path / taken.name
    shutil.copytree(taken, test)
    (test / "steps" / "0002" / "step.json").unlink()
    assert main(["measure", str(test), *ARGUMENTS]) == 0
    results = test / "exports" / "measure"
    assert sorted(p.name for p in results.glob("*.nc")) == ["step_0000.nc", "step_0001.nc", "step_0003.nc"]
    summary = json.loads((results / "summary.json").read_text())
    assert [s["step"] for s in summary["steps"]] == [0, 1, 3]
    document = gauges(test, tmp_path / "g.json")
    assert [s["n"] for s in document["steps"]] == [0, 1, 3]
    assert document["stale"] is False
