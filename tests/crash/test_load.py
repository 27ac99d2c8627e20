"""The short form of the load run: strict on losses and memory, generous on times (`make load`: the long form)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.reliability.load import Load, lines, percentile
from tests.bench.reliability.load_page import BEGIN, END, PAGE
from tests.support.patience import busy
from tests.support.requirements import ROOT

SECONDS = 24.0


@pytest.mark.deep
@pytest.mark.fault(50)
def test_captures_readers_slow_streams_an_analysis_and_stops_at_once(
    tmp_path: Path, record_property: pytest.RecordProperty
) -> None:
    figures = tmp_path / "load.json"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.bench.reliability.load",
            "--minutes",
            str(SECONDS / 60.0),
            "--json",
            str(figures),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert figures.is_file(), done.stderr
    load = Load(**json.loads(figures.read_text()))
    print("\n".join(lines(load)))
    record_property("load", "; ".join(lines(load)))
    # strictly: nothing lost, no client turned away, no stream dropped
    assert load.lost == []
    assert load.wrong == []
    assert len(load.captures) >= 30 / busy()
    assert all(n > 10_000 / busy() for n in load.streamed.values())
    assert len(load.streamed) == 2
    assert load.results > 0
    # no step kept in memory: one pair holds half a MiB, and several dozen were taken
    assert load.growth_mib(1) < 24.0
    # generously: other tests run at the same time
    assert load.latency(0.5) < 1000.0 * busy()
    assert percentile([ms for _, ms in load.stops], 0.5) < 1000.0 * busy()


def test_the_page_has_a_place_for_the_figures() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text.count(BEGIN) == text.count(END) == 1
    assert text.index(BEGIN) < text.index(END)


def test_what_does_not_hold_is_said() -> None:
    good = Load(
        seconds=60.0,
        captures=[(0.3 * n, 80.0) for n in range(200)],
        gets=[(0.1 * n, "rig", 10.0) for n in range(600)],
        stops=[(6.0 * n, 5.0) for n in range(10)],
        memory=[(0.5 * n, 300.0, 400.0) for n in range(120)],
        results=5,
    )
    assert good.faults() == []
    assert Load(**{**vars(good), "lost": ["t/3: gone"]}).faults() == ["lost: t/3: gone"]
    assert "captures of 200" in Load(**{**vars(good), "captures": good.captures[:150]}).faults()[0]
    slow = [(0.1 * n, "rig", 10.0 if n % 50 else 150.0) for n in range(600)]
    assert "plain GET p99 150.0 ms" in Load(**{**vars(good), "gets": slow}).faults()[0]
    assert "stop p99 90.0 ms" in Load(**{**vars(good), "stops": [(1.0, 90.0)]}).faults()[0]
    leaking = [(0.5 * n, 300.0 + 0.51 * n, 400.0) for n in range(120)]
    assert "memory of the service grew by 20" in Load(**{**vars(good), "memory": leaking}).faults()[0]
    assert "nothing was analysed" in Load(**{**vars(good), "results": 0}).faults()[0]
