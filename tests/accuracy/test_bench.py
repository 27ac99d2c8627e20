"""The bench's pieces work; no time is checked."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest

from tests.bench.speed import page as bench_page
from tests.bench.speed import worker
from tests.bench.speed.assembly import HERE, count_loop, innermost_loops
from tests.bench.speed.ceilings import Ceilings, CompiledLoop, fma_ir, gather_ir, load_ir, rows_ir, vector_width
from tests.bench.speed.kernel import KINDS, Costs, Rate, make_kernel_scene
from tests.bench.speed.page import Report
from tests.bench.speed.pairs import BenchScene, Errors, Request, compare, make_scene
from tests.bench.speed.parts import Parts, measure_parts
from tests.bench.speed.peer import Outcome, Run, peer_python, run_peer

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
        "files1": [str(p) for p in scene.cam1],
        "files2": [str(p) for p in scene.cam2],
        "calibration": str(scene.calibration),
        "spacing_px": 10,
    }
    run = {"steps": 1, "subset_px": 33, "region_px": TINY.region(33), "options": {"interpolation": "cubic"}}
    out = tmp_path / "out"
    worker.measure(job, run, out)
    fields = worker.read_fields(out, 1)
    errors = compare(scene, 33, fields["xyz"], fields["uvw"])
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
    errors = compare(scene, 33, xyz_cam, uvw_cam)
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


ASSEMBLY = """
before:
	vmovups	(%rdi), %ymm0
.outer:
	xorl	%eax, %eax
.inner:
	vmovups	(%rdi,%rax,4), %xmm1
	vinsertf128	$1, (%rsi,%rax,4), %ymm1, %ymm1
	vmovups	-32(%rsp), %ymm3
	vfmadd231ps	16(%rsp), %ymm1, %ymm2   # 32-byte Folded Reload
	vpermilps	$27, %ymm1, %ymm4
	vmovups	%xmm4, (%rdx)
	vgatherdps	%ymm5, (%rdi,%ymm6,4), %ymm7
	vdivps	%ymm1, %ymm2, %ymm3
	addq	$8, %rax
	jne	.inner
	decq	%rcx
	jne	.outer
	vfmadd231ps	%zmm1, %zmm1, %zmm2
	ret
"""


def test_assembly_is_counted_in_the_innermost_loop() -> None:
    (body,) = innermost_loops(ASSEMBLY)
    assert len(body) == 10
    found = count_loop("here", "loop", ASSEMBLY)
    assert found.width_bits == 256
    assert found.instructions == 10
    assert found.stack == 2
    assert found.counts == {
        "gathers": 1,
        "multiply-adds": 1,
        "divides": 1,
        "row loads": 2,
        "multiplies, adds": 0,
        "rounds, converts": 0,
        "shuffles": 1,
    }


def test_costs_and_parts_split_a_point_s_time() -> None:
    cost = Costs("cubic", 2.0, 1.0, 1.0, 3.0, 0.01, np.array([81.0]), np.array([2.0]), np.array([5.0]))
    assert cost.overhead_us(2.0) == pytest.approx(4.0)
    assert cost.time_us(1089.0, 2.0) == pytest.approx(4.0 + 1.089 + 19.602)
    split = Parts("cubic", 33, 2.0, 1.5, 0.1, 3.0, 0.4, 0.5, 0.3, 0.2, 0.1, 0.25).split_us(30.0, 2.0)
    assert split["pixel loop"] == pytest.approx(18.0)
    assert split["warp set-up"] == pytest.approx(0.6)
    assert split["factor, solve, covariance"] == pytest.approx(0.8)
    assert split["Jacobian, normal equations"] == pytest.approx(0.9)
    assert split["right-hand sides, moves"] == pytest.approx(0.5)
    assert sum(split.values()) == pytest.approx(30.0)


@pytest.mark.deep
def test_parts_of_a_fit_are_timed() -> None:
    parts = measure_parts(make_kernel_scene(40), "cubic", 9)
    times = [v for v in asdict(parts).values() if isinstance(v, float)]
    assert len(times) == 10
    assert np.isfinite(times).all()
    assert min(times) > 0.0


def test_page_holds_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_page, "DOCS", tmp_path)
    report = Report(quick=False, peer_version="1.2.3")
    for threads in (1, 2):
        levels = {"L1": 200.0, "L2": 80.0, "L3": 60.0}
        report.ceilings.append(Ceilings(threads, 8, 100.0 * threads, levels, 13.0, 18.0, 9.9, 0.97))
        for fit in ("shape", "motion"):
            for kind in KINDS:
                report.rates += [Rate(fit, kind, subset, threads, 65432.1, 2.0) for subset in (21, 33)]
    for kind in KINDS:
        for subset in (21, 33):
            report.iterations[f"motion, {kind}, {subset} px"] = np.array([2, 2, 3], dtype=np.int32)
        n, spent = np.array([81.0, 81.0, 441.0, 441.0]), np.array([2.0, 3.0, 2.0, 3.0])
        report.costs.append(Costs(kind, 2.0, 0.5, 1.0, 2.5, 0.03, n, spent, 2.0 + 0.01 * n * spent))
        report.parts += [Parts(kind, subset, 2.0, 1.5, 0.1, 1.0, 0.4, 0.5, 0.3, 0.2, 0.1, 0.25) for subset in (21, 33)]
        report.loops.append(count_loop(HERE, kind, ASSEMBLY))
    errors = Errors(0, np.array([0.01, 0.02, 0.03, 0.04]), np.array([0.1, 0.1, 0.3, 0.2]))
    worse = Errors(2, errors.mean_um, 2.0 * errors.sd_um)
    for scene in ("modern", "paper"):
        for what in ("single", "sequence"):
            run, other = Run(f"cubic {what}, 33 px", 33, 5), Run(f"tuned {what}, 33 px", 33, 5)
            report.ours.setdefault(scene, []).extend(Outcome(run, t, 9900, 2.0 / t, 2.0, errors) for t in (1, 2))
            report.peer.setdefault(scene, []).extend(Outcome(other, t, 9900, 24.0 / t, 24.0, worse) for t in (1, 2))
    page = bench_page.write_page(report).read_text()
    assert "| speed over the peer's: cubic sequence, 33 px, 2 threads | 12 |  | at least 10 | yes |" in page
    assert "worst of u, v, w: cubic sequence, 33 px, 2 threads | 0.5 |  | at most 1 | yes |" in page
    assert "| motion, cubic, 33 px, 2 threads | 65,400 | points/s | at least 60,000 | yes |" in page
    assert "| motion, cubic, 21 px, 2 threads | 65,400 | points/s | at least 120,000 | **no** |" in page
    assert "| pyvale | tuned sequence, 33 px | 2 | 12.00 | 4,120 | 2 |" in page
    for name in ("bench_peer_speed", "bench_peer_accuracy", "bench_costs", "bench_iterations", "bench_parts"):
        assert f"figures/{name}.png" in page
        assert (tmp_path / "figures" / f"{name}.png").stat().st_size > 5000
