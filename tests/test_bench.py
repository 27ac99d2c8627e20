"""The bench's pieces work; nothing here looks at a time."""

from __future__ import annotations

from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest

from docs.scripts import bench_worker
from docs.scripts.bench_ceilings import CompiledLoop, fma_ir, gather_ir, load_ir, rows_ir, vector_width
from docs.scripts.bench_pairs import BenchScene, Request, judge, make_scene
from docs.scripts.bench_peer import Run, peer_python, run_peer

TINY = Request("tiny", "sim_paper", (150, 140), (46, 46, 106, 96), 10, 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> BenchScene:
    return make_scene(TINY, tmp_path_factory.mktemp("bench"))


def test_requests_keep_the_points_of_both_programs() -> None:
    assert TINY.region(33) == (46, 46, 106, 96)
    assert TINY.region(21) == (50, 50, 110, 100)
    points = TINY.points(21)
    assert points.shape == (42, 2)
    assert set(points[:, 0] % 10) == {0.0}


def test_worker_measures_the_scene(scene: BenchScene, tmp_path: Path) -> None:
    job = {
        "files1": [str(p) for p in scene.cam1], "files2": [str(p) for p in scene.cam2],
        "calibration": str(scene.calibration), "step_px": 10,
    }  # fmt: skip
    run = {"steps": 1, "subset_px": 33, "region_px": TINY.region(33), "options": {"interpolation": "cubic"}}
    out = tmp_path / "out"
    bench_worker.measure(job, run, out)
    fields = bench_worker.read_fields(out, 1)
    errors = judge(scene, 33, fields["xyz"], fields["uvw"])
    assert errors.lost == 0
    # 33 um a pixel, 1089 px a subset, noise 2: a hundredth of a pixel would be a blunder
    assert (errors.sd_um > 0.0).all()
    assert (errors.sd_um < 0.33).all()
    assert (np.abs(errors.mean_um) < 0.33).all()


def test_judge_counts_lost_points_and_sees_offsets(scene: BenchScene) -> None:
    xyz, uvw = scene.truth(33, 1)
    pose = scene.pair.cam1.cam_from_sys
    uvw_cam, xyz_cam = uvw @ pose.rotation.T, pose.apply(xyz + np.array([0.0, 0.0, 0.002]))
    uvw_cam[0, 3] = np.nan
    errors = judge(scene, 33, xyz_cam, uvw_cam)
    assert errors.lost == 1
    np.testing.assert_allclose(errors.mean_um, [0.0, 0.0, 0.0, 2.0], atol=1e-9)


def test_peer_measures_the_scene(scene: BenchScene, tmp_path: Path) -> None:
    python = peer_python()
    if python is None:
        pytest.skip("the peer is not installed")
    version, outcomes = run_peer(python, scene, [Run("one", 33, 1, {"max_displacement": 16})], 1, tmp_path)
    assert version
    errors = outcomes[0].errors
    assert errors.lost == 0
    # a calibration carried over wrongly would show in hundreds of micrometres
    assert (np.abs(errors.mean_um) < 3.3).all()


def test_ceiling_loops_compute_what_they_say() -> None:
    index = np.arange(1024, dtype=np.int32) % 8
    data = np.full(4096 + 64, 0.5, dtype=np.float32)
    data = data[(-data.ctypes.data // 4) % 16 :]  # whole vectors are loaded aligned
    where = index.ctypes.data, data.ctypes.data
    width = vector_width()
    n = 1024
    # each chain tends to a / (1 - a) = 1, where it starts
    assert CompiledLoop("fma", fma_ir(width)).call(n, 0, *where) == pytest.approx(12 * width)
    assert CompiledLoop("load", load_ir(width)).call(n, 1023, *where) == pytest.approx(8 * width + 0.5 * n)
    assert CompiledLoop("rows", rows_ir()).call(n, 1023, *where) == pytest.approx(8 * 4 + 16 * 0.25 * n)
    if llvm.get_host_cpu_features().get("avx2"):
        assert CompiledLoop("gather", gather_ir()).call(n, 1023, *where) == pytest.approx(8 * 8 + 16 * 0.5 * n)
