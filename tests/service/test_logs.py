"""Log lines: ids of request and job, text and JSON, from threads and from the worker."""

from __future__ import annotations

import contextvars
import io
import json
import logging
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from stereorig.server.base import logs
from stereorig.server.base.logs import AboutFilter, JsonFormatter, LimitedHandler, TextFormatter, about, current_ids
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.requirements import ROOT
from tests.support.service_rig import TINY, new_test, wait_for_job, wait_for_rig

API = "/api/v1"

_log = logging.getLogger("stereorig.of_a_test")


class Lines(logging.Handler):
    """Keeps formatted lines."""

    def __init__(self, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self.addFilter(AboutFilter())
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))

    def documents(self) -> list[dict[str, object]]:
        return [json.loads(line) for line in self.lines]


@pytest.fixture
def as_json() -> Iterator[Lines]:
    handler, root = Lines(JsonFormatter()), logging.getLogger()
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    yield handler
    root.removeHandler(handler)
    root.setLevel(level)


def test_a_json_line_holds_the_ids_what_the_caller_gave_and_the_traceback(as_json: Lines) -> None:
    with about(request_id="r1"), about(job_id="j1"):
        try:
            raise ValueError("of two\nlines")
        except ValueError:
            _log.exception("it failed: %s", "why", extra={"axis": 2})
    _log.warning("nobody's")
    first, second = as_json.documents()
    assert first["message"] == "it failed: why"
    assert (first["level"], first["logger"], first["axis"]) == ("error", "stereorig.of_a_test", 2)
    assert (first["request_id"], first["job_id"]) == ("r1", "j1")
    assert "ValueError: of two\nlines" in str(first["traceback"])
    assert str(first["utc"]).endswith("Z")
    assert "request_id" not in second


def test_a_text_line_stays_one_line_whatever_a_client_sends() -> None:
    handler = Lines(TextFormatter())
    record = logging.makeLogRecord(
        {"name": "n", "levelname": "INFO", "msg": "GET %s", "args": ("/a\r\n2026 ERROR forged\x1b[2J\u2028x",)}
    )
    with about(request_id="r1"):
        handler.handle(record)
    (line,) = handler.lines
    assert len(line.splitlines()) == 1
    assert "\x1b" not in line
    assert r"/a\r\n2026 ERROR forged\x1b[2J" in line
    assert line.endswith("[request_id=r1]")


def test_the_hardware_thread_knows_whose_work_it_does() -> None:
    hardware = HardwareHold()
    try:
        with about(request_id="r2"):
            assert hardware.call(current_ids) == {"request_id": "r2"}
        assert hardware.call(current_ids) == {}
    finally:
        hardware.close()


def test_the_workers_lines_reach_the_service_and_name_the_job(as_json: Lines) -> None:
    worker = ComputeWorker(threads=1)
    try:
        with about(job_id="j000007-abcdef"):
            worker.submit(exec, "import logging; logging.getLogger('stereorig.there').warning('seen %d', 3)").result(60)
        lines = [line for line in as_json.documents() if line["logger"] == "stereorig.there"]
        assert [(line["message"], line["job_id"]) for line in lines] == [("seen 3", "j000007-abcdef")]
    finally:
        worker.shutdown()


def test_a_requests_lines_and_its_jobs_lines_can_be_told_apart(
    client: httpx.Client, service: Service, as_json: Lines
) -> None:
    wait_for_rig(client)
    made = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.3}}, headers={"X-Request-Id": "mine-1"})
    job = made.json()["job"]
    wait_for_job(client, job)
    client.get(f"{API}/jobs/%0d%0ax", headers={"X-Request-Id": "mine-2"})
    deadline = Deadline(10.0)
    while not [x for x in as_json.documents() if x.get("request_id") == "mine-2"] and deadline.left:
        time.sleep(0.01)
    lines = as_json.documents()
    states = [line["state"] for line in lines if line.get("job_id") == job["id"] and "state" in line]
    assert states == ["queued", "running", "succeeded"]
    (request,) = [line for line in lines if line["logger"] == "stereorig.http" and line["request_id"] == "mine-1"]
    assert (request["method"], request["path"], request["status"]) == ("POST", f"{API}/stage/moves", 202)
    assert request["who"] == "local"
    assert float(str(request["duration_ms"])) > 0.0


def test_ids_do_not_leak_between_threads() -> None:
    seen = []
    with about(request_id="r3"):
        plain = threading.Thread(target=lambda: seen.append(current_ids()))
        context = contextvars.copy_context()
        knowing = threading.Thread(target=lambda: seen.append(context.run(current_ids)))
        for thread in (plain, knowing):
            thread.start()
            thread.join()
    assert seen == [{}, {"request_id": "r3"}]
    assert current_ids() == {}


def test_serve_writes_json_lines_where_it_is_told(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(TINY)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "stereorig.server.cli",
            "serve",
            "--config",
            str(tmp_path / "rig.toml"),
            "--port",
            "0",
            "--data",
            str(tmp_path / "data"),
            "--log-format",
            "json",
            "--log-level",
            "info",
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        assert process.stdout is not None
        url = next(word for word in process.stdout.readline().split() if word.startswith("http://"))
        with httpx.Client(base_url=url, trust_env=False, timeout=60.0) as client:
            new_test(client)
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=60)
    lines = [json.loads(line) for line in errors.splitlines()]
    assert all({"utc", "level", "logger", "message"} <= set(line) for line in lines)
    assert any(line.get("path") == f"{API}/tests" and line["status"] == 201 for line in lines)


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LimitedHandler, list[float]]]:
    """A handler that writes into a text, and the seconds on its clock."""
    now = [0.0]
    monkeypatch.setattr(logs.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(threading.Timer, "start", lambda _: None)  # the test reports when its own clock has moved
    handler = LimitedHandler()
    handler.setFormatter(TextFormatter())
    handler.setStream(io.StringIO())
    yield handler, now
    handler.close()


def failed(depth: int = 3) -> logging.LogRecord:
    def fall(left: int) -> None:
        if left:
            fall(left - 1)
        raise OSError(24, "Too many open files")

    try:
        fall(depth)
    except OSError:
        return logging.makeLogRecord(
            {"name": "asyncio", "levelno": logging.ERROR, "levelname": "ERROR", "msg": "x", "exc_info": sys.exc_info()}
        )
    raise AssertionError


@pytest.mark.fault(60)
def test_no_second_has_more_than_100_lines_and_what_was_left_out_is_counted(
    limited: tuple[LimitedHandler, list[float]],
) -> None:
    handler, now = limited
    at: list[float] = []
    for k in range(5000):
        now[0] = k / 1000
        handler.handle(failed())
        if k % 1000 == 999:
            handler.report()
        at += [now[0]] * (len(handler.stream.getvalue().splitlines()) - len(at))
    text = handler.stream.getvalue()
    assert max(sum(t - 1.0 < other <= t for other in at) for t in at) <= 100
    assert text.count("Traceback") > 10
    counts = re.findall("([0-9]+) messages were left out", text)
    assert sum(map(int, counts)) + text.count("OSError: [Errno 24]") == 5000


def test_many_requests_do_not_crowd_out_an_error(limited: tuple[LimitedHandler, list[float]]) -> None:
    handler, _ = limited
    for _ in range(500):
        handler.handle(logging.makeLogRecord({"levelno": logging.INFO, "msg": "GET /"}))
    handler.handle(failed())
    assert "Too many open files" in handler.stream.getvalue()


def test_a_long_traceback_is_cut_and_a_wrong_call_or_a_closed_stream_prints_none(
    limited: tuple[LimitedHandler, list[float]], capfd: pytest.CaptureFixture[str]
) -> None:
    handler, now = limited
    long = logging.makeLogRecord({"levelno": logging.ERROR, "msg": "\n".join("abc"), "exc_text": "line\n" * 5000})
    handler.handle(long)
    assert len(handler.stream.getvalue().splitlines()) == 99
    handler.setStream(io.StringIO())
    now[0] = 2.0
    handler.handle(logging.makeLogRecord({"levelno": logging.ERROR, "msg": "%d", "args": ("x",)}))
    assert "cannot be formatted" in handler.stream.getvalue()
    handler.stream.close()
    handler.handle(failed())
    handler.setStream(io.StringIO())
    handler.report()
    assert "1 messages were left out" in handler.stream.getvalue()
    assert capfd.readouterr() == ("", "")


@pytest.mark.fault(60)
@pytest.mark.parametrize("form", logs.FORMATS)
def test_a_storm_of_errors_in_the_event_loop_and_in_threads_fills_no_disk(form: str) -> None:
    script = f"""
import asyncio, logging, threading, time
from stereorig.server.base import logs
logs.configure("info", {form!r})
began, sent = time.monotonic(), 0
while time.monotonic() - began < 2.5:
    loop = asyncio.new_event_loop()
    for _ in range(100):
        loop.call_exception_handler({{"message": "socket.accept() failed", "exception": OSError(24, "x")}})
    thread = threading.Thread(target=lambda: 1 / 0)
    thread.start()
    thread.join()
    loop.close()
    sent += 101
print(sent, time.monotonic() - began)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    sent, took_s = done.stdout.split()
    lines = done.stderr.splitlines()
    assert int(sent) > 1000
    assert 50 < len(lines) <= 100 * (float(took_s) + 2.0)
    assert any("were left out" in line for line in lines)
    assert any("socket.accept() failed" in line for line in lines)
