"""Deleting goes to the trash, whole and back; nothing goes there by itself."""

from __future__ import annotations

import json
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError, StateError, StorageError
from stereorig.server.cli.main import main
from stereorig.server.formats import disk as disk_module
from stereorig.server.formats.images import encode_tiff
from stereorig.server.jobs.job import Phase
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import rebuild
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.trash import Trash
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.faulty_disk import WAYS, FaultyDisk, Way
from tests.support.problems import assert_problem
from tests.support.service_rig import new_test, served, tiny_config

API = "/api/v1"


def picture(seed: int) -> bytes:
    return encode_tiff(np.random.default_rng(seed).integers(0, 255, (144, 160)).astype(np.uint8))


def add_step(client: httpx.Client, test_id: str, seed: int, **more: Any) -> int:
    files = {cam: (f"{cam}.tif", picture(10 * seed + k)) for k, cam in enumerate(("cam1", "cam2"))}
    answer = client.post(f"{API}/tests/{test_id}/steps:import", files=files, data=more)
    assert answer.status_code == 201, answer.text
    return int(answer.json()["n"])


def hashes(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def delete(client: httpx.Client, url: str) -> dict[str, Any]:
    answer = client.delete(f"{API}{url}")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def entry_of(client: httpx.Client, trash_id: str) -> dict[str, Any] | None:
    entries = client.get(f"{API}/trash").json()["trash"]
    return next((entry for entry in entries if entry["id"] == trash_id), None)


def test_a_test_goes_to_the_trash_whole_and_comes_back(service: Service, client: httpx.Client) -> None:
    test_id = new_test(client, name="ÄÖ / ..\\ test")
    for k in range(2):
        add_step(client, test_id, k)
    before = hashes(service.tests.path(test_id))
    shown = client.get(f"{API}/tests/{test_id}").json()
    gone = delete(client, f"/tests/{test_id}")
    assert gone["kind"] == "test"
    assert gone["name"] == "ÄÖ / ..\\ test"
    assert gone["deleted_by"] == "local"
    assert_problem(client.get(f"{API}/tests/{test_id}"), 404, "not_found")
    assert_problem(client.get(f"{API}/tests/{test_id}/steps/0/cam1"), 404, "not_found")
    assert_problem(client.delete(f"{API}/tests/{test_id}"), 404, "not_found")
    assert test_id not in [t["id"] for t in client.get(f"{API}/tests").json()["tests"]]
    listed = entry_of(client, gone["id"])
    assert listed is not None
    assert listed["size_bytes"] >= sum(map(len, before.values()))
    assert verify(service.folder.root).findings == ()
    assert client.post(f"{API}/trash/{gone['id']}:restore").json()["test_id"] == test_id
    assert hashes(service.tests.path(test_id)) == before
    assert client.get(f"{API}/tests/{test_id}").json() == shown
    assert entry_of(client, gone["id"]) is None
    assert_problem(client.post(f"{API}/trash/{gone['id']}:restore"), 404, "not_found")
    assert verify(service.folder.root).findings == ()


def test_a_deleted_steps_number_is_not_given_again(service: Service, client: httpx.Client) -> None:
    test_id = new_test(client)
    for k in range(3):
        add_step(client, test_id, k)
    last, first = (delete(client, f"/tests/{test_id}/steps/{n}") for n in (2, 0))
    assert last["n"] == 2
    assert [s["n"] for s in client.get(f"{API}/tests/{test_id}").json()["steps"]] == [1]
    assert add_step(client, test_id, 5) == 3
    assert verify(service.folder.root).findings == ()
    assert client.post(f"{API}/trash/{last['id']}:restore").status_code == 200
    assert [s["n"] for s in client.get(f"{API}/tests/{test_id}/steps").json()["steps"]] == [1, 2, 3]
    # once its test is gone a step has nowhere to go
    delete(client, f"/tests/{test_id}")
    assert_problem(client.post(f"{API}/trash/{first['id']}:restore"), 409, "parent_deleted")
    everything = new_test(client)
    add_step(client, everything, 1)
    delete(client, f"/tests/{everything}/steps/0")
    assert client.get(f"{API}/tests/{everything}").json()["incomplete_steps"] == []
    assert add_step(client, everything, 1) == 1
    assert service.tests.steps.deleted(everything) == [0]


def test_what_a_job_or_a_capture_uses_is_not_deleted(service: Service, client: httpx.Client) -> None:
    go = threading.Event()
    test_id = new_test(client)
    add_step(client, test_id, 1)
    analysis_id = service.tests.analyses.create(test_id, {"kind": "profile", "steps": [0]}).id
    subject = {"test_id": test_id, "analysis_id": analysis_id}
    job = service.jobs.submit("analysis", "x", subject, [Phase("compute", lambda _: go.wait(20) and None)])
    try:
        for url in (f"/tests/{test_id}", f"/tests/{test_id}/steps/0", f"/tests/{test_id}/analyses/{analysis_id}"):
            problem = assert_problem(client.delete(f"{API}{url}"), 409, "in_use")
            assert problem["job_id"] == job.id
    finally:
        go.set()
    while service.jobs.active_count():
        pass
    with service.hardware.hold("the capture of a step", test_id=test_id):
        assert_problem(client.delete(f"{API}/tests/{test_id}"), 409, "in_use")
    gone = delete(client, f"/tests/{test_id}/analyses/{analysis_id}")
    assert_problem(client.get(f"{API}/tests/{test_id}/analyses/{analysis_id}"), 404, "not_found")
    delete(client, f"/tests/{test_id}")
    assert_problem(client.delete(f"{API}/trash/x999999-abcdef"), 404, "not_found")
    assert client.delete(f"{API}/trash/{gone['id']}").status_code == 204
    assert entry_of(client, gone["id"]) is None
    assert not (service.folder.root / "trash" / gone["id"]).exists()


def test_a_test_keeps_its_own_copy_of_a_calibration_that_is_deleted(service: Service, client: httpx.Client) -> None:
    world = {f"cam{k}": _camera(k) for k in (1, 2)}
    sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(world))})
    assert sent.status_code == 201, sent.text
    calibration_id = sent.json()["id"]
    test_id = new_test(client, calibration_id=calibration_id)
    copy = service.tests.calibration_file(test_id).read_bytes()
    gone = delete(client, f"/calibrations/{calibration_id}")
    assert_problem(client.get(f"{API}/calibrations/{calibration_id}"), 404, "not_found")
    assert calibration_id not in [c["id"] for c in client.get(f"{API}/calibrations").json()["calibrations"]]
    assert_problem(client.post(f"{API}/tests", json={"name": "x", "calibration_id": calibration_id}), 404, "not_found")
    assert service.tests.calibration_file(test_id).read_bytes() == copy
    assert add_step(client, test_id, 3) == 0  # checked against the copy's image size
    assert client.post(f"{API}/trash/{gone['id']}:restore").status_code == 200
    assert client.get(f"{API}/calibrations/{calibration_id}").json()["state"] == "complete"
    noise_id = service.noise.create({"frames": 2, "label": ""})
    delete(client, f"/noise/{noise_id}")
    assert_problem(client.get(f"{API}/noise/{noise_id}"), 404, "not_found")


def _camera(k: int) -> dict[str, float]:
    sign = -1.0 if k == 1 else 1.0
    return {
        "phd_px": 3600.0,
        "cx_px": 80.0,
        "cy_px": 72.0,
        "kappa_per_px2": 0.0,
        "aspect": 0.96,
        "alpha_rad": 0.78,
        "beta_rad": 0.01,
        "gamma_rad": sign * 0.52,
        "x0_mm": 0.1,
        "y0_mm": 0.1,
        "z0_mm": 400.0,
    }


# the folder -----------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> DataFolder:
    return DataFolder(tmp_path / "data").open()


def small_test(folder: DataFolder, steps: int = 2) -> str:
    tests = TestStore(folder)
    test_id = str(tests.create({"name": "one"}, None).id)
    for k in range(steps):
        tests.steps.add(test_id, {"cam1": picture(k), "cam2": picture(k + 100)}, {})
    return test_id


@pytest.mark.normal_depth("full", "write_error")
@pytest.mark.fault(3)
@pytest.mark.parametrize("way", WAYS)
def test_a_disk_that_fails_while_something_is_deleted_keeps_all_of_it_somewhere(
    way: Way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for n in range(1, 100):
        folder = DataFolder(tmp_path / f"{n}").open()
        test_id = small_test(folder)
        before = hashes(folder.tests / test_id)
        trash = Trash(folder.root)
        faulty = FaultyDisk(way, n)
        monkeypatch.setattr(disk_module, "disk", faulty)
        refused: list[StorageError] = []
        for kind, ids in (("step", {"test_id": test_id, "n": 1}), ("test", {"test_id": test_id})):
            try:
                trash.put(folder, kind, ids, name="", by="me", why="asked for")  # type: ignore[arg-type]
            except StorageError as error:
                refused.append(error)
        monkeypatch.undo()
        assert verify(folder.root).sound
        # whatever happened, everything can be brought back
        for trash_id in reversed(trash.ids()):
            trash.restore(trash_id)
        # the manifest says what was changed and taken back: `verify` compares it with the files
        there = {k: v for k, v in hashes(folder.tests / test_id).items() if "deleted" not in k}
        assert there | {"manifest.json": before["manifest.json"]} == before
        assert verify(folder.root).sound
        folder.close()
        if not faulty.failed:
            assert not refused
            break
        assert refused, f"call {n} failed unseen"
    assert n > 1


def test_a_kill_between_the_renames_is_put_in_order_at_the_next_start(folder: DataFolder) -> None:
    test_id = small_test(folder)
    trash = Trash(folder.root)
    (folder.root / "trash").mkdir()
    begun = folder.root / "trash" / "x000001-abcdef"  # its content was never moved
    begun.mkdir()
    (begun / "trash.json").write_text("{}")
    doomed = trash.put(folder, "test", {"test_id": test_id}, name="one", by="me", why="asked for")
    (folder.root / "trash" / doomed / "content").rename(folder.root / "trash" / doomed / "removing")
    assert trash.ids() == []
    catalog = Catalog(folder.root / "catalog.sqlite").open()
    try:
        lines = rebuild(catalog, folder, CalibrationStore(folder), TestStore(folder))
    finally:
        catalog.close()
    assert sum("trash" in line for line in lines) == 2
    assert list((folder.root / "trash").iterdir()) == []
    folder.close()


@pytest.mark.fault(46)
@pytest.mark.parametrize("test_id", ["../../etc", "/etc", "t000001-abcdef/../..", ""])
def test_a_trash_document_never_leads_out_of_the_data_folder(folder: DataFolder, test_id: str) -> None:
    entry = folder.root / "trash" / "x000001-abcdef"
    (entry / "content").mkdir(parents=True)
    (entry / "trash.json").write_text(json.dumps({"kind": "test", "test_id": test_id}))
    with pytest.raises(FileFormatError) as caught:
        Trash(folder.root).restore("x000001-abcdef")
    assert caught.value.code == "trash_unreadable"
    assert (entry / "content").is_dir()
    folder.close()


def test_a_document_that_says_nothing_is_listed_and_can_be_removed(
    folder: DataFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = folder.root / "trash" / "x000001-abcdef"
    (entry / "content").mkdir(parents=True)
    (entry / "trash.json").write_text('{"kind": 7, "name": ["odd"]}')
    (listed,) = Trash(folder.root).entries()
    assert (listed.id, listed.kind) == ("x000001-abcdef", "unknown")
    assert main(["trash", "empty", "--data", str(folder.root)]) == 0
    assert "x000001-abcdef  unknown" in capsys.readouterr().out
    assert not entry.exists()
    folder.close()


def test_the_command_lists_restores_and_empties(folder: DataFolder, capsys: pytest.CaptureFixture[str]) -> None:
    data = str(folder.root)
    one, two = small_test(folder), small_test(folder)
    trash = Trash(folder.root)
    ids = [trash.put(folder, "test", {"test_id": t}, name="specimen 7", by="anna", why="asked for") for t in (one, two)]
    old = folder.root / "trash" / ids[0] / "trash.json"
    long_ago = (datetime.now(UTC) - timedelta(days=40)).isoformat()
    old.write_text(json.dumps({**json.loads(old.read_text()), "deleted_utc": long_ago}))
    assert main(["trash", "list", "--data", data]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in (*ids, one, two, "anna", "specimen 7", "MiB"))
    assert main(["trash", "restore", ids[1], "--data", data]) == 1
    assert "data_folder_locked" in capsys.readouterr().err
    # emptying goes while a service runs
    assert main(["trash", "empty", "--older-than", "30", "--data", data]) == 0
    assert trash.ids() == [ids[1]]
    folder.close()
    assert main(["trash", "restore", ids[1], "--data", data]) == 0
    assert trash.ids() == []
    assert verify(folder.root).findings == ()
    assert (folder.tests / two / "steps" / "0001" / "step.json").is_file()
    for wrong in (["restore"], ["restore", ids[0]], ["empty", ids[0]], ["list", "x"], ["empty", "--older-than", "-1"]):
        assert main(["trash", *wrong, "--data", data]) == 1
    assert main(["trash", "list", "--data", str(folder.root / "tests")]) == 1
    capsys.readouterr()
    assert main(["trash", "empty", "--data", data]) == 0
    assert main(["trash", "list", "--data", data]) == 0
    assert "the trash is empty" in capsys.readouterr().out


# copies elsewhere ------------------------------------------------------------------------------------------------


def test_a_copy_is_acknowledged_only_where_it_holds_what_the_test_has(tmp_path: Path) -> None:
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        with served(service) as client:
            test_id = new_test(client)
            add_step(client, test_id, 1)
            too_little = client.post(f"{API}/tests/{test_id}:acknowledge-export", json={"steps": 0, "results": 0})
            problem = assert_problem(too_little, 409, "export_differs")
            assert problem["steps"] == 1
            answer = client.post(f"{API}/tests/{test_id}:acknowledge-export", json={"steps": 1, "results": 0})
            assert answer.status_code == 200
            assert client.get(f"{API}/tests/{test_id}").json()["exported"]["steps"] == 1
            assert client.get(f"{API}/trash").json()["trash"] == []
    finally:
        service.close()


def test_restoring_over_what_is_there_is_refused(folder: DataFolder) -> None:
    test_id = small_test(folder)
    trash = Trash(folder.root)
    trash_id = trash.put(folder, "test", {"test_id": test_id}, name="", by="me", why="asked for")
    (folder.tests / test_id).mkdir()
    with pytest.raises(StateError) as caught:
        trash.restore(trash_id)
    assert caught.value.code == "place_taken"
    folder.close()
