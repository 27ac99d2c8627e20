"""The bench's pieces work; no time is checked."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest

from stereorig.core.arrays import Float
from tests.bench.speed import layout, worker
from tests.bench.speed import page as bench_page
from tests.bench.speed.assembly import HERE, count_loop, innermost_loops
from tests.bench.speed.ceilings import Ceilings, CompiledLoop, fma_ir, gather_ir, load_ir, rows_ir, vector_width
from tests.bench.speed.ending import measure_ending
from tests.bench.speed.kernel import KINDS, Costs, Rate, make_kernel_scene
from tests.bench.speed.page import Report
from tests.bench.speed.pairs import BenchScene, Errors, Request, compare, make_scene
from tests.bench.speed.parts import Parts, measure_parts
from tests.bench.speed.peers.plan import WARM, own_runs, peer_runs
from tests.bench.speed.peers.programs import ALDIC, PEERS, PYVALE, Peer, Setting
from tests.bench.speed.peers.runs import Beside, Outcome, Run, run_peer
from tests.bench.speed.sequence import run_child

PEERS_FOLDER = Path(layout.__file__).parent / "peers"
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
    errors = compare(scene, TINY.points(33), fields["xyz"], fields["uvw"])
    assert errors.lost == 0
    # 33 um a pixel, 1089 px a subset, noise 2: a hundredth of a pixel would be a blunder
    assert (errors.sd_um > 0.0).all()
    assert (errors.sd_um < 0.33).all()
    assert (np.abs(errors.mean_um) < 0.33).all()


def test_judge_counts_lost_points_and_sees_offsets(scene: BenchScene) -> None:
    xyz, uvw = scene.truth(TINY.points(33), 1)
    pose = scene.pair.cam1.cam_from_sys
    uvw_cam, xyz_cam = uvw @ pose.rotation.T, pose.apply(xyz + np.array([0.0, 0.0, 0.002]))
    uvw_cam[0, 3] = np.nan
    errors = compare(scene, TINY.points(33), xyz_cam, uvw_cam)
    assert errors.lost == 1
    np.testing.assert_allclose(errors.mean_um, [0.0, 0.0, 0.0, 2.0], atol=1e-9)


PLAIN = Setting("plain", {}, "plain")
FAKE = Peer(
    "fake", "fake", "bench-fake", "json", "fake.py", "STEREORIG_BENCH_FAKE", (PLAIN,), "plain", "the fake's", ""
)
SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
from job import measure_runs, read_job
import numpy as np
job = read_job()
print("a line of its own")
measure_runs(job, "7", lambda run, out: (out / "seen").touch(), lambda run, out: np.load({fields!r}))
"""


def fake_peer(folder: Path, scene: BenchScene, points: Float, spacing_px: int | None) -> Peer:
    """A peer that finds the truth at its points, 3 um off in camera 1's X, without the first one's displacement."""
    xyz, uvw = scene.truth(points, 1)
    pose = scene.pair.cam1.cam_from_sys
    moved = uvw @ pose.rotation.T + np.array([0.003, 0.0, 0.0])
    moved[0, 0] = np.nan
    fields, script = folder / "known.npz", folder / "fake.py"
    np.savez(fields, x=points[:, 0], y=points[:, 1], xyz=pose.apply(xyz), uvw=moved)
    script.write_text(SCRIPT.format(folder=str(PEERS_FOLDER), fields=str(fields)))
    return replace(FAKE, script=str(script), spacing_px=spacing_px)


@pytest.mark.parametrize("spacing_px", [None, 4])
def test_a_peer_s_fields_are_judged_at_the_points_it_measured(
    scene: BenchScene, tmp_path: Path, spacing_px: int | None
) -> None:
    points = TINY.points(33)
    if spacing_px is not None:  # nodes of its own, some pixels inside the region
        x, y = np.meshgrid(np.arange(46, 107, spacing_px), np.arange(47, 97, spacing_px))
        points = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    peer = fake_peer(tmp_path, scene, points, spacing_px)
    version, (outcome,) = run_peer(peer, Path(sys.executable), scene, [Run("one", 33, 1, repeats=2)], 1, tmp_path)
    assert version == "7"
    assert outcome.points == len(points)
    assert outcome.errors.lost == 1
    assert outcome.errors.sd3_um < 1e-6
    assert np.linalg.norm(outcome.errors.mean_um[:3]) == pytest.approx(3.0)


def test_a_peer_that_measures_other_points_is_refused(scene: BenchScene, tmp_path: Path) -> None:
    peer = fake_peer(tmp_path, scene, TINY.points(33) + 1.0, None)
    with pytest.raises(RuntimeError, match="did not measure the points"):
        run_peer(peer, Path(sys.executable), scene, [Run("one", 33, 1)], 1, tmp_path)


def test_every_program_measures_the_kinds_that_are_compared() -> None:
    for all_threads in (False, True):
        own = own_runs("modern", all_threads=all_threads, quick=False)
        for peer in PEERS:
            theirs = peer_runs(peer, "modern", all_threads=all_threads, quick=False)
            assert theirs[0].name.startswith(WARM)
            compared = {(r.kind, r.subset_px) for r in theirs[1:] if r.setting == peer.compared}
            assert compared == {(r.kind, r.subset_px) for r in own if not r.name.startswith(WARM)}
    # what is measured once only is left out of the short form
    assert {r.setting for r in peer_runs(PYVALE, "paper", all_threads=True, quick=True)[1:]} == {"tuned"}


def test_a_peer_is_looked_for_where_it_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FAKE.variable, "/nowhere/python")
    assert FAKE.interpreter() is None
    monkeypatch.setenv(FAKE.variable, sys.executable)
    assert FAKE.interpreter() == Path(sys.executable)
    assert FAKE.environment.name == ".venv-bench-fake"
    built = replace(FAKE, built=True)  # the variable names its program, which this interpreter's script runs
    assert built.interpreter() == Path(sys.executable)
    monkeypatch.delenv(FAKE.variable)
    assert built.interpreter() is None


@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_peer_measures_the_scene(scene: BenchScene, tmp_path: Path, peer: Peer) -> None:
    python = peer.interpreter()
    if python is None:
        pytest.skip(peer.how_to_install)
    (setting,) = (s for s in peer.settings if s.name == peer.compared)
    version, outcomes = run_peer(peer, python, scene, [Run("one", 33, 1, setting.options)], 1, tmp_path)
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


def test_what_a_program_takes_is_its_own() -> None:
    held = np.ones(40_000_000)  # 320 MB here, which a child would have for a moment
    used = run_child(["-c", "import os, time; time.sleep(0.2); print(len(os.sched_getaffinity(0)))"], threads=1)
    assert held.nbytes > 3e8
    assert 5.0 < used.peak_mb < 100.0
    assert used.wall_s > 0.2
    assert used.cpu_s < used.wall_s
    assert used.output.split() == ["1"]
    with pytest.raises(RuntimeError, match="ended with 3: gone"):
        run_child(["-c", "print('gone'); raise SystemExit(3)"])


def test_a_fit_s_ending_is_judged_beside_full_iteration() -> None:
    ending = measure_ending("cubic", 21, repeats=3, size_px=120)
    # 3 x 9 points x 3 components: a scatter's own scatter is 8 %; both see the same noise
    assert ending.over_bound == pytest.approx(1.0, abs=0.3)
    assert ending.over_bound == pytest.approx(ending.full_over_bound, abs=0.01)
    assert 0.0 < ending.bias_px < 0.01
    assert ending.lost == 0
    assert [row.limit for row in ending.rows()] == [1.03, None, 1e-3, 0]


@pytest.mark.deep
def test_parts_of_a_fit_are_timed() -> None:
    parts = measure_parts(make_kernel_scene(40), "cubic", 9)
    times = [v for v in asdict(parts).values() if isinstance(v, float)]
    assert len(times) == 10
    assert np.isfinite(times).all()
    assert min(times) > 0.0


def test_page_holds_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "DOCS", tmp_path)
    report = Report(quick=False, peers=[Beside(PYVALE, "1.2.3"), Beside(ALDIC, "4.5.6")])
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
        for what, steps, took in (("single", 1, 0.4), ("sequence", 5, 2.0)):
            run = Run(f"cubic {what}, 33 px", 33, steps)
            report.ours.setdefault(scene, []).extend(Outcome(run, t, 9900, took / t, took, errors) for t in (1, 2))
            for beside, slower in zip(report.peers, (12, 24), strict=True):
                other = Run(f"{beside.peer.compared} {what}, 33 px", 33, steps)
                beside.outcomes.setdefault(scene, []).extend(
                    Outcome(other, t, 9900, took * slower / t, took * slower, worse) for t in (1, 2)
                )
    (tmp_path / "explanation").mkdir()
    marks = "<!-- measured: begin -->\n<!-- measured: end -->\n"
    (tmp_path / "explanation" / "performance.md").write_text(f"# Performance\n\n{marks}\nKept.\n")
    page = bench_page.write_page(report).read_text()
    assert page.endswith("\n\nKept.\n")
    assert "| speed over the peer's: cubic single, 33 px, 2 threads | 12 |  | at least 10 | yes |" in page
    assert "| speed over the peer's: cubic sequence, 33 px, 2 threads | 12 |  | at least 30 | **no** |" in page
    assert "| speed over the peer's: 9,900 points, cubic single, 33 px, 2 threads | 12 |  | at least 5 | yes |" in page
    assert "| 9,900 points: cubic single, 33 px, 2 threads | 0.2 | s | at most 0.12 | **no** |" in page
    assert "worst of u, v, w: cubic sequence, 33 px, 2 threads | 0.5 |  | at most 1 | yes |" in page
    assert "| motion, cubic, 33 px, 2 threads | 65,400 | points/s | at least 120,000 | **no** |" in page
    assert "| motion, cubic, 21 px, 2 threads | 65,400 | points/s | at least 200,000 | **no** |" in page
    tables = {path.stem: path.read_text() for path in (tmp_path / "explanation" / "performance").iterdir()}
    assert '"speed over the peer\'s: cubic single, 33 px, 1 thread",12,,,' in tables["targets"]
    assert '"speed over al-dic-3d\'s: cubic sequence, 33 px, 2 threads",24,,,' in tables["targets"]
    assert '"the same, steps after the first alone",24,,,' in tables["targets"]
    assert '"motion, cubic, 33 px, 2 threads","65,400",points/s,"at least 120,000",no' in tables["targets"]
    assert 'pyvale,"tuned sequence, 33 px",2,12.00,"9,900","4,120",2,' in tables["peers_1"]
    assert 'al-dic-3d,"local sequence, 33 px",2,24.00,"9,900","2,060",2,' in tables["peers_2"]
    assert "# **al-dic-3d** 4.5.6: " in tables["peers_1"]
    every = "".join(tables.values())
    for name in ("bench_peer_speed", "bench_peer_accuracy", "bench_costs", "bench_iterations", "bench_parts"):
        assert f"figures/{name}.png" in every
        assert (tmp_path / "figures" / f"{name}.png").stat().st_size > 5000
