"""The bench of whole measurements on small pictures: its pieces work; no time is checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.bench.speed import sequence as bench
from tests.bench.speed.scene import sequence_files
from tests.bench.speed.sequence_page import Figures


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "ROI", "40,40,199,159")
    monkeypatch.setattr(bench, "POINTS", 16 * 12)
    monkeypatch.setattr(bench, "SUBSET_PX", 21)
    monkeypatch.setattr(bench, "SEED_SIZE", (240, 200))


def test_a_sequence_is_rendered_once_and_runs_back_and_forth(tmp_path: Path) -> None:
    files = sequence_files(tmp_path, steps=4, pictures=2, size_px=(64, 48))
    names = sorted(p.name for p in files.folder.glob("cam1_*.tif"))
    assert names == [f"cam1_{n:04d}.tif" for n in range(5)]
    data = [(files.folder / name).read_bytes() for name in names]
    assert data[1] == data[3]  # 1, 2, 1, 2
    assert data[2] == data[4]
    assert len({data[0], data[1], data[2]}) == 3


def test_stages_of_a_sequence_are_told_apart(tmp_path: Path, small: None) -> None:
    files = sequence_files(tmp_path, steps=3, pictures=2, size_px=(240, 200))
    out = tmp_path / "out"
    job = {"arguments": files.arguments(bench.ROI, out, "--subset", "21"), "out": str(out)}
    found = bench.child_sequence(job)
    assert len(found["files_s"]) == 4
    assert np.all(np.diff(found["files_s"]) > 0)
    assert found["valid"] > 0.7  # camera 2 does not see the rest of so small a sensor
    assert set(found["stages"]) == {stage for stage, _, _ in bench.STAGES}
    assert found["stages"]["fit"][0] > 0
    assert found["stages"]["write"][0] > 0
    assert found["stages"]["strain"][0] > 0  # as every user has it, who does not turn it off
    assert (out / "summary.json").exists()


def test_a_process_of_its_own_is_measured_from_its_start_to_its_end() -> None:
    used = bench.run_child(["-c", "x = bytearray(200_000_000); print('done')"])
    assert used.output.strip() == "done"
    assert used.peak_mb > 200
    assert used.cpu_s > 0
    with pytest.raises(RuntimeError, match="ended with 3"):
        bench.run_child(["-c", "raise SystemExit(3)"])


def test_figures_become_rows_and_sections(tmp_path: Path, small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.bench.speed.layout.DOCS", tmp_path)
    figures = Figures(
        seeds=bench.measure_seeds(tmp_path, threads=1, runs=1),
        points=bench.measure_points(tmp_path, (20, 40), threads=1, runs=1),
    )
    assert all(found.seeds > 0 for found in figures.seeds)
    assert [len(row.what) > 0 for row in figures.rows()]
    titles = [title for title, _ in figures.sections()]
    assert titles == ["Seeds", "Cost against points"]
    assert (tmp_path / "figures" / "bench_points.png").stat().st_size > 1000
