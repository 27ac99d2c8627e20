"""The service killed two hundred times at work: nothing acknowledged is lost, and it is soon ready again."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import statistics
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.bench.reliability import torture_page
from tests.bench.reliability.torture import ACTS, Outcome, Running, children_of, is_there, summary, torture
from tests.bench.reliability.torture_lab import Lab, Pictures
from tests.support.patience import busy

#: the issue's demand
READY_S = 5.0
KILLS = 12
KILLS_IN_DEPTH = int(os.environ.get("STEREORIG_KILLS", "200"))


@pytest.mark.fault(1)
@pytest.mark.fault(2)
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kills", [KILLS, pytest.param(KILLS_IN_DEPTH, marks=pytest.mark.deep)])
def test_killed_at_any_instant_it_loses_nothing_and_is_soon_ready(tmp_path: Path, kills: int) -> None:
    seed = random.SystemRandom().randrange(10**6)
    print(f"python -m tests.bench.reliability.torture --kills {kills} --seed {seed}")
    outcome = torture(tmp_path, kills, seed, tell=print)
    print(summary(outcome))
    if (path := os.environ.get("STEREORIG_KILLS_JSON")) is not None:  # for the page, with others: torture --page
        Path(path).write_text(json.dumps(outcome.document()))
    assert not outcome.wrong, outcome.wrong
    assert sum(outcome.kills.values()) == kills
    assert outcome.counts["steps"] > kills
    # nothing of a killed service lives on beside the next one
    assert statistics.median(outcome.left_s) < 1.0 * busy()
    # on a machine that has other things to do, what counts is the processor time that a start takes
    assert statistics.median(start["ready_s"] for start in outcome.forked) < READY_S * busy()
    cold = [min(start["ready_s"], max(start["service_cpu_s"], start["worker_cpu_s"])) for start in outcome.cold]
    assert not cold or statistics.median(cold) < READY_S, outcome.cold


# the harness itself: each kind of loss is seen -------------------------------------------------------------------


class Lies(httpx.BaseTransport):
    """A service that answers from a table."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers = answers

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self.answers.get(request.url.path, {})
        if isinstance(answer, bytes):
            return httpx.Response(200, content=answer)
        return httpx.Response(200, json=answer)


class NoPictures(Pictures):
    def __init__(self) -> None:
        self.pairs = []

    def write_test(self, folder: Path) -> None:
        folder.mkdir(parents=True)


def lies() -> dict[str, Any]:
    return {
        "/tests": {"tests": []},
        "/trash": {"trash": []},
        "/calibrations": {"calibrations": []},
        "/tests/t1": {"incomplete_steps": []},
        "/tests/t1/steps": {"steps": [{"n": 0}]},
        "/jobs/j1": {"state": "interrupted"},
    }


@pytest.mark.parametrize(
    ("answers", "complaint"),
    [
        ({}, None),
        ({"/tests/t1/steps": {"steps": []}}, "are lost"),
        ({"/tests/t1": {"incomplete_steps": [1]}}, "0 steps had no answer"),
        ({"/tests/t1/steps": {"steps": [{"n": 0}, {"n": 1}]}}, "0 steps had no answer"),
        ({"/tests/t1/steps/0": {"n": 0, "label": "another"}}, "is not what was acknowledged"),
        ({"/tests/t1/steps/0/cam1": b"other pixels"}, "cam1 of step 0"),
        ({"/jobs/j1": {"state": "running"}}, "reads running"),
        ({"/calibrations": {"calibrations": [{"id": "c1", "state": "unfinished"}]}}, "reads unfinished"),
        ({"/tests": {"tests": [{"id": "t2"}]}, "/trash": {"trash": [{"test_id": "t2"}]}}, "test t2 is"),
        ({"/trash": {"trash": []}}, "nowhere"),
    ],
)
def test_every_kind_of_loss_is_seen(
    answers: dict[str, Any], complaint: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab(tmp_path / "data", NoPictures(), 1)
    monkeypatch.setattr(Lab, "_check_files", lambda self: None)
    content = b"pixels"
    sha256 = hashlib.sha256(content).hexdigest()
    step = {"n": 0, "test_id": "t1", "sha256": {"cam1": sha256, "cam2": sha256}}
    good = {"/tests/t1/steps/0": step, "/tests/t1/steps/0/cam1": content, "/tests/t1/steps/0/cam2": content}
    good["/trash"] = {"trash": [{"test_id": "t2"}]}
    lab.steps["t1", 0] = step
    lab.fresh.add(("t1", 0))
    lab.jobs["j1"] = "running"
    lab.deleted["t2"] = {"trash"}
    with httpx.Client(base_url="http://x", transport=Lies({**lies(), **good, **answers})) as client:
        lab.check(client)
    if complaint is None:
        assert lab.wrong == []
    else:
        assert any(complaint in line for line in lab.wrong), lab.wrong


def test_files_that_are_not_what_was_acknowledged_are_seen(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "data", NoPictures(), 1)
    (lab.data / "format.json").write_text('{"format": 1}')
    lab.steps["t000001-abcdef", 0] = {"sha256": {"cam1": "x", "cam2": "y"}}
    lab._check_files()
    assert any("step.json of step 0" in line for line in lab.wrong)
    assert any(
        "verify: foreign" in line or "verify: index" in line or "verify: incomplete" in line for line in lab.wrong
    )


def test_a_service_that_ends_by_itself_is_seen(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "data", NoPictures(), 1)
    lab.test_id = "t000001-abcdef"
    lab._until_over(lab._capture, "http://127.0.0.1:9")
    assert "stopped answering by itself" in lab.wrong[0]


def test_the_page_says_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = {
        "answers_s": 1.0,
        "captures_s": 1.2,
        "ready_s": 2.5,
        "service_cpu_s": 2.0,
        "worker_cpu_s": 2.2,
        "first": 1.0,
    }
    run = Outcome(Counter(record=7), Counter(steps=12345), [], [start], [start, {**start, "ready_s": 6.5}], [0.1], 60.0)
    both = torture_page.joined([run.document(), run.document()])
    assert (both["kills"], both["counts"]["steps"], len(both["cold"])) == (14, 24690, 4)
    page = tmp_path / "reliability.md"
    page.write_text(f"before {torture_page.BEGIN} older words {torture_page.END} after")
    monkeypatch.setattr(torture_page, "PAGE", page)
    monkeypatch.setattr(torture_page, "DOCS", tmp_path)
    torture_page.write_page(json.loads(json.dumps(both)))
    text = page.read_text()
    assert text.startswith("before ")
    assert text.endswith(" after")
    assert "older words" not in text
    assert "14 kills: 0 acknowledged things lost or wrong" in text
    assert "24 690" in text
    assert "6.50 s" in text
    assert (tmp_path / "figures" / torture_page.FIGURE).stat().st_size > 10_000
    assert set(torture_page._ACTS) == set(ACTS)


def test_processes_are_found_by_their_parent() -> None:
    with subprocess.Popen(["sleep", "60"]) as process:
        assert process.pid in children_of(os.getpid())
        running = Running(process.pid, 0.0, Path("out"), Path("err"), process)
        assert running.end(signal.SIGKILL) == []
        assert not is_there(process.pid)
