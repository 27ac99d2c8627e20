"""`stereorig verify` and `repair` on a data folder that a service wrote, and that something happened to."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sqlite3
import threading
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError, StateError
from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.http.access import KeyFile
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.repair import repair
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.requirements import ROOT
from tests.support.service_rig import SMALL, new_test, served, wait_for_job, wait_for_rig

API = "/api/v1"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a calibration, a test of three steps and an analysis, its service ended."""
    data = tmp_path_factory.mktemp("verify") / "data"
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            plan = {"positions_mm": [0, 5], "held_out_mm": [2], "frames": 2}
            accepted = client.post(f"{API}/calibrations", json=plan).json()
            done = wait_for_job(client, accepted["job"])
            assert done["state"] == "succeeded", done["problem"]
            test_id = new_test(client, calibration_id=accepted["calibration_id"])
            client.put(f"{API}/sim/scene", json={"scene": "plate"}).raise_for_status()
            for _ in range(3):
                client.post(f"{API}/tests/{test_id}/steps", json={}).raise_for_status()
            body = {"region": {"rectangle": [80, 80, 160, 150]}, "subset_px": 21, "spacing_px": 10, "strain": None}
            accepted = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
            done = wait_for_job(client, accepted["job"], 240.0)
            assert done["state"] == "succeeded", done["problem"]
    finally:
        service.close()
    return data


@pytest.fixture
def data(written: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "data"
    shutil.copytree(written, copy)
    return copy


def only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    assert found, pattern
    return found[0]


def flip(path: Path) -> None:
    """Flip one bit in the middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


def found_in(data: Path) -> list[tuple[str, str]]:
    return [(finding.level, finding.path) for finding in verify(data).findings]


def test_what_the_service_wrote_is_sound(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = verify(data)
    assert found.findings == ()
    # by hand: views, images, residuals and results; every document; checksums beside
    kinds = ("*.tif", "*.nc", "calibrations/**/*.json", "tests/**/*.json", "*.sha256")
    files = {path for kind in kinds for path in data.rglob(kind) if path.name != "manifest.json"}
    assert found.files == len(files)
    assert found.unknown == 0
    assert main(["verify", str(data)]) == 0
    assert "sound" in capsys.readouterr().out


def test_the_checksums_beside_results_are_those_that_sha256sum_reads(data: Path) -> None:
    for result in data.rglob("step_*.nc"):
        line = result.with_name(result.name + ".sha256").read_text()
        assert line == f"{hashlib.sha256(result.read_bytes()).hexdigest()}  {result.name}\n"


@pytest.mark.fault(4)
@pytest.mark.parametrize(
    "pattern",
    [
        "tests/*/steps/0001/cam2.tif",
        "tests/*/analyses/*/step_0002.nc",
        "tests/*/calibration.json",
        "calibrations/*/views/000_cam1.tif",
        "calibrations/*/residuals.nc",
    ],
)
def test_a_flipped_bit_names_its_file_alone(data: Path, pattern: str, capsys: pytest.CaptureFixture[str]) -> None:
    victim = only(data, pattern)
    flip(victim)
    name = victim.relative_to(data).as_posix()
    assert found_in(data) == [("damaged", name)]
    assert main(["verify", str(data), "--json"]) == 1
    shown = json.loads(capsys.readouterr().out)
    assert shown["sound"] is False
    assert [finding["path"] for finding in shown["findings"]] == [name]


@pytest.mark.fault(4)
def test_a_spoiled_result_is_refused_by_the_service_and_the_others_stand(data: Path) -> None:
    flip(only(data, "tests/*/analyses/*/step_0002.nc"))
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            test_id = client.get(f"{API}/tests").json()["tests"][0]["id"]
            analysis = only(data, "tests/*/analyses/*/analysis.json").parent.name
            url = f"{API}/tests/{test_id}/analyses/{analysis}/steps"
            answer = client.get(f"{url}/2/fields/z_mm")
            assert answer.status_code == 409
            assert answer.json()["code"] == "checksum_mismatch"
            assert "step_0002.nc" in answer.json()["detail"]
            values = client.get(f"{url}/1/fields/z_mm").json()["values"]
            assert np.isfinite(np.array(values, dtype=float)).any()
    finally:
        service.close()


def test_what_is_gone_cut_short_or_foreign_is_told(data: Path) -> None:
    gone = only(data, "tests/*/steps/0002/cam1.tif")
    gone.unlink()
    cut = only(data, "tests/*/analyses/*/analysis.json")
    cut.write_text(cut.read_text()[:50])
    (data / "holiday.jpg").write_bytes(b"x")
    (data / "tests" / "mine").mkdir()
    levels = {path: level for level, path in found_in(data)}
    assert levels[gone.relative_to(data).as_posix()] == "damaged"
    assert levels[cut.relative_to(data).as_posix()] == "damaged"
    assert levels["holiday.jpg"] == "foreign"
    assert levels["tests/mine"] == "foreign"


@pytest.mark.fault(5)
def test_a_catalogue_that_is_gone_or_wrong_is_made_anew_and_every_difference_listed(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(data / "catalog.sqlite") as catalog:
        catalog.execute("DELETE FROM entries WHERE kind = 'step' AND id = '0001'")
        catalog.execute("INSERT INTO entries VALUES ('test', '', 't999999-abcdef', '{}')")
    catalog.close()
    texts = [finding.text for finding in verify(data).findings]
    assert len(texts) == 2
    assert any("0001 is not in the catalogue" in text for text in texts)
    assert "test t999999-abcdef has no folder" in texts
    assert main(["repair", str(data)]) == 0
    shown = capsys.readouterr().out
    assert "0001 was not in the catalogue" in shown
    assert "t999999-abcdef has no folder" in shown
    assert verify(data).findings == ()
    (data / "catalog.sqlite").write_bytes(b"no database at all" * 1000)
    assert any("cannot be read" in finding.text for finding in verify(data).findings)
    assert any("quarantined and replaced" in line for line in repair(data).done)
    assert verify(data).findings == ()


@pytest.mark.fault(5)
def test_a_backup_as_the_operation_page_makes_it_is_whole(data: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how_to" / "operate.md").read_text(encoding="utf-8")
    left_out = re.findall(r"--exclude='?([^' ]+)", page)
    assert "service.lock" in left_out
    (data / "tests" / ".test.json.12345678.part").write_text("{")  # written at that moment
    backup = tmp_path / "backup"
    shutil.copytree(data, backup, ignore=shutil.ignore_patterns(*left_out))
    assert not list(backup.rglob("catalog.sqlite*"))
    assert [finding.level for finding in verify(backup).findings] == ["index"]
    assert repair(backup).after.findings == ()
    listed = [(path.relative_to(data), path.read_bytes()) for path in sorted((data / "tests").rglob("*.nc"))]
    assert listed
    assert all((backup / name).read_bytes() == content for name, content in listed)


@pytest.mark.fault(1)
def test_incomplete_steps_are_set_aside_and_the_numbers_stay(data: Path) -> None:
    test = only(data, "tests/*/test.json").parent
    shutil.copytree(test / "steps" / "0001", test / "steps" / "0003", ignore=shutil.ignore_patterns("step.json"))
    half = test / "steps" / "0002" / ".step.json.12345678.part"
    half.write_text("{")
    beside = only(test, "analyses/*/step_0001.nc.sha256")
    shutil.copy(beside, beside.with_name("step_0007.nc.sha256"))
    assert ("incomplete", f"tests/{test.name}/steps/0003") in found_in(data)
    outcome = repair(data)
    assert len([line for line in outcome.done if "quarantined" in line and "as incomplete-1-0003" in line]) == 1
    assert (test / "steps" / "incomplete-1-0003" / "cam1.tif").is_file()
    assert not half.exists()
    assert outcome.after.findings == ()
    again = repair(data)
    assert again.done == ()
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            shown = client.get(f"{API}/tests/{test.name}").json()
            assert [step["n"] for step in shown["steps"]] == [0, 1, 2]
            assert client.post(f"{API}/tests/{test.name}/steps", json={}).json()["n"] == 4
    finally:
        service.close()


def test_a_test_whose_every_step_is_incomplete_begins_at_zero_again(data: Path) -> None:
    test = only(data, "tests/*/test.json").parent
    folder = DataFolder(data).open()
    for step in sorted((test / "steps").iterdir()):
        (step / "step.json").unlink()
        folder.manifests.strike(test, [f"steps/{step.name}/step.json"])  # none was ever acknowledged
    folder.close()
    repair(data)
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            assert client.post(f"{API}/tests/{test.name}/steps", json={}).json()["n"] == 0
    finally:
        service.close()


@pytest.mark.fault(6)
def test_no_repair_under_a_running_service(data: Path) -> None:
    folder = DataFolder(data).open()
    try:
        with pytest.raises(StateError) as caught:
            repair(data)
        assert caught.value.code == "data_folder_locked"
        assert verify(data).findings == ()
    finally:
        folder.close()


@pytest.mark.fault(6)
def test_what_a_running_service_is_writing_is_no_finding_and_what_stays_is(data: Path) -> None:
    test = only(data, "tests/*")
    under_way, left = test / ".test.json.0a1b2c3d.part", test / ".test.json.4e5f6071.part"
    folder = DataFolder(data).open()
    try:
        for path in (under_way, left):
            path.write_text("{")
        written = threading.Timer(0.5, under_way.unlink)
        written.start()
        assert [finding.path for finding in verify(data).findings] == [left.relative_to(data).as_posix()]
        written.join()
    finally:
        folder.close()


@pytest.mark.fault(10)
def test_what_is_no_data_folder_or_a_newer_one_is_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError) as caught:
        verify(tmp_path / "nothing")
    assert caught.value.code == "no_data_folder"
    (data / "format.json").write_text('{"format": 99}')
    for check in (verify, repair):
        with pytest.raises(FileFormatError) as caught:
            check(data)
        assert caught.value.code == "data_format_newer"


def everything_else(client: httpx.Client) -> None:
    """What else a service writes: decisions, metadata, a watch, noise, an export, and something in the trash."""
    test_id = client.get(f"{API}/tests").json()["tests"][0]["id"]
    test = f"{API}/tests/{test_id}"
    body: dict[str, Any] = {"region": {"rectangle": [80, 80, 160, 150]}, "subset_px": 21, "strain": None}
    calibration = client.get(f"{API}/calibrations").json()["calibrations"][0]["id"]
    decision = {"decision": "accepted", "note": "good"}
    client.put(f"{API}/calibrations/{calibration}/review", json=decision).raise_for_status()
    client.put(f"{test}/metadata", json={"operator": "A. Smith"}).raise_for_status()
    client.put(f"{test}/watch", json={"channel": "load_n", "threshold": 1.0}).raise_for_status()
    analysis = client.get(test).json()["analyses"][0]["id"]
    client.get(f"{test}/analyses/{analysis}/export", params={"format": "csv"}).raise_for_status()
    kept = []
    for _ in range(2):
        noise = client.post(f"{API}/noise", json={"frames": 2}).json()
        assert wait_for_job(client, noise["job"])["state"] == "succeeded"
        kept.append(noise["noise_id"])
    other = new_test(client, calibration_id=calibration)
    client.post(f"{API}/tests/{other}/steps", json={}).raise_for_status()
    step = client.post(f"{test}/steps", json={}).json()["n"]
    cancelled = client.post(f"{test}/analyses", json={**body, "follow": True, "noise_id": kept[0]}).json()
    client.post(f"{API}/jobs/{cancelled['job']['id']}:cancel").raise_for_status()
    wait_for_job(client, cancelled["job"])
    for gone in (f"/tests/{test_id}/steps/{step}", f"/tests/{other}", f"/noise/{kept[1]}"):
        client.delete(API + gone).raise_for_status()


def test_a_folder_that_holds_everything_has_no_false_finding_and_hides_no_true_one(data: Path) -> None:
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            everything_else(client)
            assert verify(data).findings == ()  # while the service runs on it
    finally:
        service.close()
    KeyFile(data).add("script-1", "operator")
    found = verify(data)
    assert found.findings == ()
    assert found.unknown == 0
    assert main(["repair", str(data)]) == 0
    assert verify(data).findings == ()
    for pattern in ("calibrations/*", "tests/*", "tests/*/steps/0000", "tests/*/analyses/*", "noise/*"):
        (sorted(data.glob(pattern))[0] / "holiday.jpg").write_bytes(b"x")
    (only(data, "calibrations/*") / "review.json").write_text("{")
    for pattern in ("trash/*/content/cam2.tif", "trash/*/content/steps/0000/cam1.tif", "trash/*/content/noise.json"):
        flip(only(data, pattern))
    levels = [level for level, _ in found_in(data)]
    assert sorted(levels) == 4 * ["damaged"] + 5 * ["foreign"]
