"""Disks as they really are: full ones and read-only ones, mounted for the test alone, under the whole service."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import StateError, StorageError
from stereorig.server.documents.jobs import JobRecord, Progress
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from tests.support.job_bench import Bench
from tests.support.patience import Deadline
from tests.support.requirements import ROOT, missing
from tests.support.service_rig import TINY


def record(job_id: str, **more: Any) -> JobRecord:
    progress = Progress(phase="", done=0, total=0, eta_s=None)
    fields = {"id": job_id, "kind": "analysis", "state": "running", "subject": {}, "progress": progress}
    return JobRecord.model_validate({**fields, "created_utc": "2026-03-01T12:00:00Z", **more})


def run_with_mounts(script: str, folder: Path) -> dict[str, Any]:
    """Run a script in a mount namespace of its own; nothing that it mounts is seen or left outside."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        missing("root and the program unshare (apt-get install util-linux), for mounts of its own,")
    body = textwrap.indent(script, "    ")  # the worker's process loads it too
    (folder / "script.py").write_text(f'def main():\n{body}\n\nif __name__ == "__main__":\n    main()\n')
    (folder / "rig.toml").write_text(TINY.replace("[service]", "[service]\nfree_reserve_mib = 0.0"))
    done = subprocess.run(
        ["unshare", "-m", sys.executable, str(folder / "script.py"), str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-6000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


FULL = """
import hashlib, json, subprocess, sys, time
from pathlib import Path

folder = Path(sys.argv[1])
data = folder / "data"
data.mkdir()
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=5m", "tmpfs", str(data)], check=True)

from stereorig.server.config.rig_file import load_config
from stereorig.server.workflows.service import Service
from stereorig.server.store.verify import verify
from tests.support.service_rig import new_test, served, wait_for_job, wait_for_rig
from tests.support.copied_tests import write_test_folder

write_test_folder(data / "tests" / "t000007-abcdef", 12)
(data / "ballast").write_bytes(bytes(1_600_000))
service = Service(load_config(folder / "rig.toml"), data).start()
out = {}
try:
    with served(service) as client:
        wait_for_rig(client)
        api = "/api/v1"
        # steps until the disk is full
        test_id, acknowledged = new_test(client), []
        while (answer := client.post(f"{api}/tests/{test_id}/steps", json={})).status_code == 201:
            acknowledged.append(answer.json())
        out["step"] = [answer.status_code, answer.json()["code"], answer.json()["remedy"]]
        out["steps"] = len(acknowledged)
        wrong = []
        for step in acknowledged:
            for cam in ("cam1", "cam2"):
                content = client.get(f"{api}/tests/{test_id}/steps/{step['n']}/{cam}").content
                if hashlib.sha256(content).hexdigest() != step["sha256"][cam]:
                    wrong.append(step["n"])
        out["wrong"] = wrong
        out["shown"] = len(client.get(f"{api}/tests/{test_id}").json()["steps"])
        # an administrator makes room
        (data / "ballast").unlink()
        again = new_test(client)
        out["again"] = client.post(f"{api}/tests/{again}/steps", json={}).status_code
        # room for a few results, not for all
        free = service.folder.free_mib() * 2**20
        (data / "ballast").write_bytes(bytes(max(0, int(free) - 700_000)))
        body = {"region": {"rectangle": [25, 25, 130, 115]}, "subset_px": 21, "spacing_px": 4, "strain": None}
        made = client.post(f"{api}/tests/t000007-abcdef/analyses", json=body).json()
        job = wait_for_job(client, made["job"])
        out["job"] = [job["state"], (job["problem"] or {}).get("code")]
        url = f"{api}/tests/t000007-abcdef/analyses/{made['analysis_id']}"
        shown = client.get(url).json()
        out["finished"] = shown["steps_finished"]
        out["readable"] = [client.get(f"{url}/steps/{n}/fields/z_mm").status_code for n in shown["steps_finished"]]
        out["analysis"] = [shown["state"], shown["problem"]["code"]]
        (data / "ballast").unlink()
        out["damaged"] = [f.text for f in verify(data).findings if f.level == "damaged"]
        out["after"] = client.post(f"{api}/tests/{again}/steps", json={}).status_code
finally:
    service.close()
print(json.dumps(out))
"""


@pytest.mark.fault(3)
@pytest.mark.timeout(1800)
def test_a_disk_that_fills_up_while_it_captures_and_analyses(tmp_path: Path) -> None:
    out = run_with_mounts(FULL, tmp_path)
    assert out["step"][:2] == [507, "storage_full"]
    assert out["step"][2]
    assert out["steps"] > 10
    assert out["shown"] == out["steps"]
    assert out["wrong"] == []
    assert out["again"] == 201, "room that was made is used at once"
    assert out["job"] == ["failed", "storage_full"]
    assert out["analysis"] == ["failed", "storage_full"]
    assert 1 <= len(out["finished"]) < 12
    assert set(out["readable"]) == {200}
    assert out["damaged"] == []
    assert out["after"] == 201


TO_THE_LAST_BYTE = """
import json, subprocess, sys, time
from pathlib import Path

folder = Path(sys.argv[1])
data = folder / "data"
data.mkdir()
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(data)], check=True)

from stereorig.server.config.rig_file import load_config
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.service_rig import new_test, served, wait_for_job, wait_for_rig

def fill():
    with open(data / "ballast", "ab", buffering=0) as file:
        for size in (65536, 4096):
            try:
                while file.write(bytes(size)) == size:
                    pass
            except OSError:
                pass
    assert service.folder.free_mib() == 0.0

service = Service(load_config(folder / "rig.toml"), data).start()
out = {}
try:
    with served(service) as client:
        wait_for_rig(client)
        service.worker.ready.wait(240)
        api = "/api/v1"
        test_id = new_test(client)
        fill()
        ready = client.get("/readyz")
        out["ready"] = [ready.status_code, [r["code"] for r in ready.json()["reasons"]]]
        out["capture"] = client.post(f"{api}/tests/{test_id}/steps", json={}).json()["code"]
        moves = []
        for k in range(120):
            key = {"Idempotency-Key": f"m{k}"} if k % 2 else {}
            body = {"positions_mm": {"1": 0.1 + 0.01 * (k % 3)}}
            answer = client.post(f"{api}/stage/moves", json=body, headers=key)
            if answer.status_code != 202:
                moves.append([answer.status_code, answer.json()["code"]])
                continue
            ended = wait_for_job(client, answer.json()["job"])
            moves.append([answer.status_code, ended["state"]])
            if key:
                again = client.post(f"{api}/stage/moves", json=body, headers=key).json()["job"]["id"]
                assert again == answer.json()["job"]["id"]
        out["moves"] = sorted({tuple(move) for move in moves})
        homed = client.post(f"{api}/stage:home", json={"axes": [1]})
        out["home"] = [homed.status_code, wait_for_job(client, homed.json()["job"])["state"]]
        out["listed"] = len(client.get(f"{api}/jobs?limit=200").json()["jobs"])
        last = homed.json()["job"]["id"]
        deadline = Deadline(30.0)  # a line is written once its answer is sent
        while deadline.left:
            written = (data / "audit.log").read_bytes()
            out["audit"] = [written.count(b"/api/v1/stage"), written.count(bytes(1))]
            if out["audit"][0] == 181:
                break
        (data / "ballast").unlink()
        again = client.post(f"{api}/tests/{test_id}/steps", json={})
        out["again"] = [again.status_code, client.get("/readyz").status_code]
finally:
    service.close()
service = Service(load_config(folder / "rig.toml"), data).start()
try:
    out["kept"] = service.jobs.document(last).state
finally:
    service.close()
print(json.dumps(out))
"""


@pytest.mark.fault(3)
@pytest.mark.timeout(1800)
def test_on_a_disk_without_a_byte_the_stage_moves_and_each_change_has_its_audit_line(tmp_path: Path) -> None:
    out = run_with_mounts(TO_THE_LAST_BYTE, tmp_path)
    assert out["ready"] == [503, ["storage_full"]]
    assert out["capture"] == "storage_full"
    assert out["moves"] == [[202, "succeeded"]]
    assert out["home"] == [202, "succeeded"]
    assert out["audit"] == [120 + 60 + 1, 0]
    assert out["listed"] == 120 + 1
    assert out["again"] == [201, 200]
    assert out["kept"] == "succeeded", "what the disk had no room for is written once there is some"


READ_ONLY = """
import json, subprocess, sys
from pathlib import Path

folder = Path(sys.argv[1])
data = folder / "data"
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder

opened = DataFolder(data).open()
Catalog(data / "catalog.sqlite").open().close()
opened.close()
subprocess.run(["mount", "--bind", str(data), str(data)], check=True)
subprocess.run(["mount", "-o", "remount,ro,bind", str(data)], check=True)
command = [sys.executable, "-m", "stereorig.server.cli"]
serve = subprocess.run([*command, "serve", "--config", str(folder / "rig.toml"), "--port", "0", "--data", str(data)],
                       capture_output=True, text=True, timeout=600)
looked = subprocess.run([*command, "verify", str(data), "--json"], capture_output=True, text=True, timeout=600)
mended = subprocess.run([*command, "repair", str(data)], capture_output=True, text=True, timeout=600)
out = {"serve": [serve.returncode, serve.stdout, serve.stderr], "repair": [mended.returncode, mended.stderr]}
print(json.dumps({**out, "verify": [looked.returncode, json.loads(looked.stdout)]}))
"""


@pytest.mark.fault(8)
def test_a_data_folder_on_a_read_only_disk_is_refused_with_the_reason_and_can_be_verified(tmp_path: Path) -> None:
    out = run_with_mounts(READ_ONLY, tmp_path)
    status, shown, errors = out["serve"]
    assert status == 1
    assert shown == ""
    last = errors.splitlines()[-1]
    assert last.startswith("stereorig: data_folder_unusable: ")
    assert "Read-only file system" in last
    assert "--data" in last
    assert out["verify"] == [0, {"sound": True, "files_verified": 0, "files_without_checksum": 0, "findings": []}]
    assert out["repair"][0] == 1
    assert "data_folder_unusable" in out["repair"][1]


@pytest.mark.fault(8)
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.EIO])
def test_a_disk_without_locks_is_refused_and_not_taken_for_one_in_use(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", fails)
    with pytest.raises(StorageError) as caught:
        DataFolder(tmp_path / "data").open()
    assert caught.value.code == "data_folder_unusable"
    assert os.strerror(number) in caught.value.cause
    assert caught.value.remedy


@pytest.mark.fault(8)
def test_a_disk_whose_locks_do_not_exclude_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "flock", lambda *_: None)
    with pytest.raises(StorageError) as caught:
        DataFolder(tmp_path / "data").open()
    assert caught.value.code == "data_folder_unusable"
    assert "lock" in caught.value.cause
    monkeypatch.undo()
    DataFolder(tmp_path / "data").open().close()


@pytest.mark.fault(8)
def test_a_disk_whose_rename_does_not_replace_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = Path.replace

    def stays(self: Path, target: Path) -> Path:
        return Path(target) if Path(target).exists() else replace(self, target)

    monkeypatch.setattr(Path, "replace", stays)
    with pytest.raises(StorageError) as caught:
        DataFolder(tmp_path / "data").open()
    assert caught.value.code == "data_folder_unusable"


@pytest.mark.fault(6)
def test_a_second_service_still_reads_as_such(tmp_path: Path) -> None:
    first = DataFolder(tmp_path / "data").open()
    with pytest.raises(StateError) as caught:
        DataFolder(tmp_path / "data").open()
    assert caught.value.code == "data_folder_locked"
    assert caught.value.context["holder"] == f"process {os.getpid()} on {os.uname().nodename}"
    first.close()


@pytest.mark.fault(3)
def test_a_job_that_ended_with_the_disk_full_never_reads_as_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path)
    go = threading.Event()
    job = bench.jobs.submit("analysis", "an analysis", {}, [Phase("compute", lambda _: go.wait(20) and None)])
    while job.record.state == "queued":
        time.sleep(0.005)

    def full(*_: object) -> None:
        raise StorageError("No space left.", code="storage_full")

    monkeypatch.setattr(bench.catalog, "put_job", full)
    go.set()
    while bench.jobs.is_active(job.id):
        time.sleep(0.005)
    assert bench.catalog.job(job.id).state == "running"  # type: ignore[union-attr]
    assert bench.jobs.document(job.id).state == "succeeded"
    assert bench.jobs.documents(10)[0].state == "succeeded"
    monkeypatch.undo()
    other = bench.jobs.submit("analysis", "an analysis", {}, [Phase("compute", lambda _: None)])
    bench.end_of(other)
    deadline = Deadline(20.0)
    while bench.catalog.job(job.id).state != "succeeded" and deadline.left:  # type: ignore[union-attr]
        time.sleep(0.005)
    assert bench.catalog.job(job.id).state == "succeeded", "written once there is room"  # type: ignore[union-attr]
    bench.close()


@pytest.mark.fault(3)
def test_a_catalogue_whose_commit_failed_works_again_once_there_is_room(tmp_path: Path) -> None:
    catalog = Catalog(tmp_path / "catalog.sqlite").open()
    catalog.put_job(record("j000001-abcdef"))

    def limit(pages: int) -> None:
        catalog.transact(lambda c: c.execute(f"PRAGMA max_page_count = {pages}").fetchone())

    limit(8)
    for _ in range(3):
        with pytest.raises(StorageError) as caught:
            catalog.put_job(record("j000002-abcdef", text="x" * 30000))
        assert caught.value.code == "storage_full", "and not that a transaction is still open"
    limit(100000)
    catalog.put_job(record("j999999-abcdef"))
    assert catalog.job("j999999-abcdef") == record("j999999-abcdef")
    catalog.close()


@pytest.mark.fault(3)
def test_a_stage_moves_though_no_disk_takes_its_record_but_a_key_is_kept_or_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path)

    def full(*_: object) -> None:
        raise StorageError("No space left.", code="storage_full")

    def submit(key: str | None) -> Job:
        sent, phase = RequestMark("moves", key, "x"), Phase("hardware", lambda _: {"axes": {}})
        return bench.jobs.submit("move", "a move", {}, [phase], request=sent, without_disk=True)

    with monkeypatch.context() as patch:
        patch.setattr(bench.catalog, "put_job", full)
        job = submit(None)
        while bench.jobs.is_active(job.id):
            time.sleep(0.005)
        assert bench.jobs.document(job.id).state == "succeeded"
        with pytest.raises(StorageError):
            submit("a key")
        assert bench.jobs.active_count() == 0
    other = submit("a key")
    bench.end_of(other)
    deadline = Deadline(20.0)
    while bench.catalog.job(job.id) is None and deadline.left:
        time.sleep(0.005)
    assert bench.catalog.job(job.id).state == "succeeded"  # type: ignore[union-attr]
    bench.close()
