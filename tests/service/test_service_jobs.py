"""Jobs: states, cancellation, bounds, what a restart makes of them; the data folder and its lock."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import Cancelled, FileFormatError, StateError, StorageError
from stereorig.server.base.errors import BusyError, QueueFullError
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task
from tests.support import worker_functions as work
from tests.support.job_bench import Bench
from tests.support.patience import busy
from tests.support.requirements import ROOT
from tests.support.service_rig import TINY, new_test, served, tiny_config, wait_for_job, wait_for_rig


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def compute(run: Any) -> list[Phase]:
    return [Phase("compute", run)]


def test_a_job_tells_stage_share_and_time_left(bench: Bench) -> None:
    go, began = threading.Event(), time.monotonic()

    def run(job: Job) -> dict[str, Any]:
        job.progress("walking", 0, 4)
        time.sleep(0.1)
        job.progress("walking", 1, 4)
        go.wait(10)
        return {"answer": float("nan")}

    job = bench.jobs.submit("walk", "a walk", {"x": 1}, compute(run))
    while job.document().progress.done < 1:
        time.sleep(0.005)
    document = bench.jobs.document(job.id).plain()
    assert document["state"] == "running"
    assert document["progress"]["phase"] == "walking"
    assert 0.2 < document["progress"]["eta_s"] < 3.0 * max(1.0, time.monotonic() - began)
    go.set()
    done = bench.end_of(job)
    assert done["state"] == "succeeded"
    assert done["result"] == {"answer": None}
    assert done["progress"]["eta_s"] is None
    names = [e.data["state"] for e in bench.hub.after(0) if e.name == "job"]
    assert names[0] == "queued"
    assert names[-1] == "succeeded"


def test_hardware_jobs_exclude_each_other_and_name_the_holder(bench: Bench) -> None:
    go = threading.Event()
    job = bench.jobs.submit("move", "a move", {}, [Phase("hardware", lambda _: go.wait(10) and None)])
    with pytest.raises(BusyError) as caught:
        bench.jobs.submit("move", "another", {}, [Phase("hardware", lambda _: None)])
    assert caught.value.context["holder"]["job_id"] == job.id
    go.set()
    assert bench.end_of(job)["state"] == "succeeded"
    assert bench.hardware.holder is None


@pytest.mark.fault(28)
def test_what_is_done_to_a_holder_never_meets_the_next_one() -> None:
    """A cancelled job is stopped again until it has let go; the next holder of the hardware must not be stopped."""
    hardware = HardwareHold()
    first = hardware.claim("a move", job_id="j1")
    stopping, stopped, order = threading.Event(), threading.Event(), []

    def stop() -> None:
        stopping.set()
        assert stopped.wait(10.0)
        order.append("stopped")

    stopper = threading.Thread(target=lambda: hardware.while_held_by("j1", stop))
    stopper.start()
    assert stopping.wait(10.0)
    assert hardware.holder is not None  # looking waits for nothing
    hardware.release(first)  # nor does letting go
    assert hardware.holder is None

    def next_one() -> None:
        hardware.claim("another move", job_id="j2")
        order.append("claimed")

    other = threading.Thread(target=next_one)
    other.start()
    other.join(0.2)
    assert order == []
    stopped.set()
    stopper.join(10.0)
    other.join(10.0)
    assert order == ["stopped", "claimed"]
    assert not hardware.while_held_by("j1", lambda: order.append("too late"))
    assert order == ["stopped", "claimed"]
    hardware.close()


def test_hardware_is_free_while_the_second_phase_computes(bench: Bench) -> None:
    go = threading.Event()
    phases = [Phase("hardware", lambda _: {"a": 1}), Phase("compute", lambda _: go.wait(10) and {"b": 2})]
    job = bench.jobs.submit("calibration", "a calibration", {}, phases)
    while bench.hardware.holder is not None:
        time.sleep(0.005)
    with bench.hardware.hold("somebody else"):
        go.set()
        assert bench.end_of(job)["result"] == {"a": 1, "b": 2}


def test_the_queue_is_bounded_and_recovers(bench: Bench) -> None:
    go = threading.Event()
    first = bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: go.wait(10) and None))
    while bench.jobs.waiting_count():
        time.sleep(0.005)
    waiting = [bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None)) for _ in range(2)]
    with pytest.raises(QueueFullError):
        bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None))
    assert bench.jobs.cancel(waiting[0].id).state == "cancelled"
    third = bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None))
    go.set()
    assert [bench.end_of(j)["state"] for j in (first, waiting[1], third)] == ["succeeded"] * 3


def test_a_failure_keeps_code_cause_and_remedy(bench: Bench) -> None:
    def run(_: Job) -> None:
        raise StorageError("The disk is gone.")

    problem = bench.end_of(bench.jobs.submit("analysis", "an analysis", {}, compute(run)))["problem"]
    assert problem["code"] == "storage_failed"
    assert problem["detail"] == "The disk is gone."
    assert problem["remedy"]


def test_a_job_whose_end_cannot_be_written_is_no_success(bench: Bench) -> None:
    def end(_: Job, state: str) -> None:
        raise StorageError(f"no room for the summary of a {state} job")

    job = bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None), on_end=end)
    assert bench.end_of(job)["state"] == "failed"


@pytest.mark.fault(2)
def test_what_ran_at_a_crash_reads_interrupted_after_the_next_start(tmp_path: Path) -> None:
    first = Bench(tmp_path)
    go = threading.Event()
    running = first.jobs.submit("analysis", "an analysis", {}, compute(lambda _: go.wait(10) and None))
    queued = first.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None))
    while running.record.state == "queued":
        time.sleep(0.005)
    shutil.copytree(tmp_path, tmp_path / "copy", ignore=shutil.ignore_patterns("copy"))  # what a kill leaves behind
    go.set()
    first.close()
    second = Bench(tmp_path / "copy")
    try:
        for job in (running, queued):
            document = second.jobs.document(job.id).plain()
            assert document["state"] == "interrupted"
            assert document["problem"]["code"] == "interrupted"
        fresh = second.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None))
        assert fresh.id > queued.id
        assert second.end_of(fresh)["state"] == "succeeded"
    finally:
        second.close()


@pytest.mark.fault(5)
def test_a_corrupt_catalogue_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "catalog.sqlite"
    path.write_bytes(b"no database" * 500)
    catalog = Catalog(path).open()
    assert catalog.was_reset
    assert catalog.jobs() == []
    catalog.close()
    assert (tmp_path / "catalog.corrupt-1.sqlite").read_bytes().startswith(b"no database")


# the data folder ------------------------------------------------------------------------------------------------


@pytest.mark.fault(6)
def test_second_service_on_a_data_folder_is_told_who_has_it(tmp_path: Path) -> None:
    first = DataFolder(tmp_path).open()
    with pytest.raises(StateError, match=r"process [0-9]+ on ") as caught:
        DataFolder(tmp_path).open()
    assert caught.value.code == "data_folder_locked"
    first.close()
    DataFolder(tmp_path).open().close()


@pytest.mark.fault(10)
def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    DataFolder(tmp_path).open().close()
    (tmp_path / "format.json").write_text('{"format": 3}')
    with pytest.raises(FileFormatError, match="format 3"):
        DataFolder(tmp_path).open()


@pytest.mark.fault(8)
def test_an_unusable_data_folder_is_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match="cannot be used") as caught:
        DataFolder(tmp_path / "file").open()
    assert caught.value.code == "data_folder_unusable"


@pytest.mark.fault(8)
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_data_folder_whose_disk_does_not_keep_its_promises_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, call, fails)
    with pytest.raises(StorageError, match="Read-only") as caught:
        DataFolder(tmp_path).open()
    assert caught.value.code == "data_folder_unusable"
    monkeypatch.undo()
    DataFolder(tmp_path).open().close()  # the refusal let go of the lock


# the whole service ----------------------------------------------------------------------------------------------


@pytest.mark.fault(5)
def test_index_is_rebuilt_and_keys_still_count_after_the_catalogue_is_lost(tmp_path: Path) -> None:
    key = {"Idempotency-Key": "only-once"}
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            test_id = new_test(client)
            first = client.post(f"/api/v1/tests/{test_id}/steps", json={}, headers=key).json()
    finally:
        service.close()
    for path in (tmp_path / "data").glob("catalog.sqlite*"):
        path.unlink()
    half = tmp_path / "data" / "tests" / test_id / "steps" / "0001"
    half.mkdir()
    (half / "cam1.tif").write_bytes(b"half a step")
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        assert any("was not in the catalogue" in line for line in service.index.differences)
        with served(service) as client:
            wait_for_rig(client)
            shown = client.get(f"/api/v1/tests/{test_id}").json()
            assert [s["n"] for s in shown["steps"]] == [0]
            assert shown["incomplete_steps"] == [1]
            again = client.post(f"/api/v1/tests/{test_id}/steps", json={}, headers=key).json()
            assert again == first
            assert client.get(f"/api/v1/tests/{test_id}/steps/1").status_code == 404
            assert client.post(f"/api/v1/tests/{test_id}/steps", json={}).json()["n"] == 2
    finally:
        service.close()


def test_killed_worker_fails_its_job_and_is_started_again(tmp_path: Path) -> None:
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            job = service.jobs.submit(
                "analysis",
                "an analysis",
                {},
                compute(lambda j: {"n": run_task(service.worker, j, work.count, 500, 0.02)}),
            )
            while job.document().progress.done < 1:
                time.sleep(0.01)
            pid = service.worker.pid
            subprocess.run(["kill", "-9", str(pid)], check=True)
            done = wait_for_job(client, {"id": job.id})
            assert done["state"] == "failed"
            assert done["problem"]["code"] == "worker_died"
            job = service.jobs.submit(
                "analysis", "an analysis", {}, compute(lambda j: {"n": run_task(service.worker, j, work.count, 3, 0.0)})
            )
            assert wait_for_job(client, {"id": job.id})["result"] == {"n": 3}
            assert service.worker.pid != pid

            job = service.jobs.submit(
                "analysis", "an analysis", {}, compute(lambda j: run_task(service.worker, j, work.count, 500, 0.02))
            )
            while job.document().progress.done < 1:
                time.sleep(0.01)
            asked = time.monotonic()
            assert client.post(f"/api/v1/jobs/{job.id}:cancel").json()["state"] in ("cancelling", "cancelled")
            assert wait_for_job(client, {"id": job.id})["state"] == "cancelled"
            assert time.monotonic() - asked < 1.0 * busy()
    finally:
        service.close()


# the command ----------------------------------------------------------------------------------------------------


def serve(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "stereorig.server.cli", "serve", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--host", "0.0.0.0"], "bind_needs_keys"),
        (["--host", "192.168.1.4"], "bind_needs_keys"),
        (["--config", "nowhere.toml"], "file_missing"),
        (["--port", "99999"], "port_unusable"),
    ],
)
def test_serve_refuses_in_one_line(tmp_path: Path, arguments: list[str], code: str) -> None:
    done = serve("--data", str(tmp_path / "data"), *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith(f"stereorig: {code}: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("max_skew_ms = 1.0", "max_skew_ms = -1.0", "rig.max_skew_ms"),
        ("settle_ms = 0", "settle_ms = nan", "stage.settle_ms"),
        ("frames = 2", "framez = 2", "calibration.framez"),
        ('driver = "esp301"', 'driver = "esp302"', "stage.driver"),
        ("soft_limits_mm = [-6.0, 6.0]", "soft_limits_mm = [6.0, -6.0]", "stage"),
        ("[target]", "[taget]", "target"),
    ],
)
def test_wrong_rig_files_name_the_field_in_one_line(tmp_path: Path, old: str, new: str, field: str) -> None:
    from stereorig.server.config.rig_file import load_config

    path = tmp_path / "rig.toml"
    path.write_text(TINY.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        load_config(path)
    assert caught.value.code == "config_invalid"
    assert f"rig.toml: {field}: " in caught.value.cause
    assert "\n" not in str(caught.value)


def test_serve_announces_itself_and_ends_in_order(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(TINY)
    command = [sys.executable, "-m", "stereorig.server.cli", "serve", "--config", str(path), "--port", "0", "--data"]
    process = subprocess.Popen(
        [*command, str(tmp_path / "data")], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "http://127.0.0.1:" in line
    second = subprocess.run(
        [*command, str(tmp_path / "data")], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert second.returncode == 1
    assert (
        f"data_folder_locked: The data folder {tmp_path / 'data'} is in use by process {process.pid}" in second.stderr
    )
    process.terminate()
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 0
    assert errors == ""


def test_job_table_survives_in_sqlite_with_full_sync(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    job = bench.jobs.submit("analysis", "an analysis", {}, compute(lambda _: None))
    bench.end_of(job)
    bench.close()
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
        text = connection.execute("SELECT document FROM jobs WHERE id = ?", (job.id,)).fetchone()[0]
    connection.close()
    assert json.loads(text)["state"] == "succeeded"


def test_cancelled_raises_in_the_phase(bench: Bench) -> None:
    seen = []

    def run(job: Job) -> None:
        try:
            while True:
                job.check()
                time.sleep(0.005)
        except Cancelled:
            seen.append(True)
            raise

    job = bench.jobs.submit("analysis", "an analysis", {}, compute(run))
    while job.record.state == "queued":
        time.sleep(0.005)
    bench.jobs.cancel(job.id)
    assert bench.end_of(job)["state"] == "cancelled"
    assert seen == [True]


def test_a_service_that_was_only_made_has_opened_nothing(tmp_path: Path) -> None:
    threads = threading.active_count()
    service = Service(tiny_config(), tmp_path / "data")
    assert threading.active_count() == threads
    assert list(tmp_path.iterdir()) == []
    service.close()


def test_a_start_that_fails_closes_what_was_opened_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> list[str]:
        raise StorageError("The index cannot be made.")

    monkeypatch.setattr("stereorig.server.workflows.service.Index.begin", broken)
    threads = threading.active_count()
    with pytest.raises(StorageError), Service(tiny_config(), tmp_path / "data"):
        pass
    assert threading.active_count() == threads
    DataFolder(tmp_path / "data").open().close()
