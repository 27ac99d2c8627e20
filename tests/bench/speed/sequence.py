"""Time whole measurements, files on disk to files on disk: ``python -m tests.bench.speed.sequence``, a part of ``make bench``.

A sequence with a breakdown by stage, the first field of a fresh process, feature seeds, cost against the number of points, and memory. What
counts a process's time or memory from its start runs in a process of its own, on as many cores as threads are asked for.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.field.growth.seed import match_seeds
from stereorig.core.field.growth.state import begin, prepare
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureImage, MeasureOptions, ReferencePair
from stereorig.core.threads import available_threads, set_threads
from stereorig.server.formats.images import read_image
from tests.bench.accuracy.paper_rig import ROOT
from tests.bench.speed.scene import SEQUENCE_SIZE, SequenceFiles, sequence_files

ROI = "60,100,1150,990"  # 110 x 90 points at a step of 10 px
POINTS = 9900
SIZE_PX = SEQUENCE_SIZE
SUBSET_PX = 33
SEED_SIZE = (2448, 2048)
LARGE_SIZE, LARGE_POINTS = (6000, 4000), 250_000
STAGES = (
    # what, where it is looked up (module, or module:class), under which name
    ("read and decode", "stereorig.server.compute.sequence", "read_image"),
    ("splines", "stereorig.core.field.points.images", "prepare"),
    ("fit", "stereorig.core.field.points.fitter", "fit_motion"),
    ("checks", "stereorig.core.field.growth.check", "apply_validity_checks"),
    ("assemble", "stereorig.core.field.growth.field", "assemble"),
    ("parts of subsets", "stereorig.core.field.growth.check", "reject_straddling"),
    ("cameras' offsets", "stereorig.server.compute.camera_watch:CameraWatch", "judge"),
    ("systematic", "stereorig.server.compute.beside", "terms_of"),
    ("common factor", "stereorig.core.field.common:CommonParts", "of"),
    ("strain", "stereorig.server.compute.sequence", "strain_of_step"),
    ("window's bias", "stereorig.server.compute.sequence", "with_strain"),
    ("summary", "stereorig.server.compute.sequence", "summarise"),
    ("strain's summary", "stereorig.server.compute.sequence", "summarise_strain"),
    ("write", "stereorig.server.compute.sequence", "write_field"),
)
#: on threads of their own
BESIDE = (
    "read and decode",
    "splines",
    "cameras' offsets",
    "systematic",
    "common factor",
    "strain",
    "window's bias",
    "summary",
    "strain's summary",
    "write",
)
_CHILD_TIMEOUT_S = 1800
_LAUNCH = Path(__file__).with_name("launch.py")


@dataclass(frozen=True)
class Used:
    """What a process took from its start to its end."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    output: str


@dataclass(frozen=True)
class SequenceFigures:
    """One sequence, at one number of threads.

    ``rate`` counts the points of the steps after the first field, over the time from the first field's file to the last one's;
    ``stages`` holds (wall, processor) milliseconds a step.
    """

    threads: int
    suffix: str
    interpolation: str
    steps: int
    rate: float
    step_s: float
    first_field_s: float
    valid: float
    stages: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class SeedFigures:
    """Feature seeds of one pair, or of one pair and a later one."""

    what: str
    threads: int
    wall_s: float
    cpu_s: float
    seeds: int


@dataclass(frozen=True)
class PointCost:
    """A field of so many points: seconds of the shape, of the first motion and of a later step."""

    points: int
    shape_s: float
    first_s: float
    later_s: float


def run_child(arguments: list[str], *, threads: int | None = None, cache: Path | None = None) -> Used:
    """Run Python with ``arguments`` in a process of its own, on ``threads`` cores; its peak is that of resident memory."""

    def on_few_cores() -> None:
        if threads is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])

    # the command keeps its libraries to one thread; a child that calls it has loaded them before
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    # an installed program has its bytecode, whatever this machine's settings for development are
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    environment["PYTHONPYCACHEPREFIX"] = str(Path(tempfile.gettempdir()) / "stereorig-bench-bytecode")
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "took.json"
        launched = subprocess.run(
            [sys.executable, "-I", "-S", str(_LAUNCH), str(report), sys.executable, *arguments],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=on_few_cores,
            timeout=_CHILD_TIMEOUT_S,
            check=False,
        )
        if launched.returncode != 0:
            raise RuntimeError(f"{arguments} ended with {launched.returncode}: {launched.stdout[-2000:]}")
        took = json.loads(report.read_text())
    kilobytes = took["peak"] / (1024 if sys.platform == "darwin" else 1)
    return Used(took["wall_s"], took["cpu_s"], kilobytes / 1000.0, launched.stdout)


# a sequence


@contextmanager
def timed_stages() -> Iterator[list[tuple[str, float, float, float]]]:
    """Note (stage, end, wall, processor seconds of the calling thread) of every call of the stages' functions."""
    import importlib

    events: list[tuple[str, float, float, float]] = []

    def timed(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **more: Any) -> Any:
            wall, cpu = time.perf_counter(), time.thread_time()
            result = function(*args, **more)
            now = time.perf_counter()
            events.append((stage, now, now - wall, time.thread_time() - cpu))
            return result

        return call

    kept = []
    try:
        for stage, place, name in STAGES:
            module_name, _, of_class = place.partition(":")
            holder: Any = importlib.import_module(module_name)
            if of_class:
                holder = getattr(holder, of_class)
            kept.append((holder, name, getattr(holder, name)))
            setattr(holder, name, timed(stage, getattr(holder, name)))
        yield events
    finally:
        for module, name, function in kept:
            setattr(module, name, function)


def child_sequence(job: dict[str, Any]) -> dict[str, Any]:
    """In a process of its own: one ``stereorig measure`` over a sequence, and when each file was there."""
    from stereorig.server.cli.main import main

    out = Path(job["out"])
    warm = [*job["arguments"][: job["arguments"].index("--out")], "--out", str(out / "warm")]
    for option in ("--cam1", "--cam2"):  # kernels loaded, files in the page cache: the reference and one step
        at = warm.index(option) + 1
        warm[at : at + 1] = [str(p) for p in sorted(Path(warm[at]).parent.glob(Path(warm[at]).name))[:2]]
    if main(warm) != 0:
        raise RuntimeError("the measurement failed")
    start = time.perf_counter()
    with timed_stages() as events:
        if main(job["arguments"]) != 0:
            raise RuntimeError("the measurement failed")
    files = [end - start for stage, end, _, _ in events if stage == "write"]
    later = [(stage, wall, cpu) for stage, end, wall, cpu in events if end - start > files[1]]
    steps = len(files) - 2
    stages = {
        stage: (
            1e3 * sum(w for s, w, _ in later if s == stage) / steps,
            1e3 * sum(c for s, _, c in later if s == stage) / steps,
        )
        for stage, _, _ in STAGES
    }
    summary = json.loads((out / "summary.json").read_text())
    valid = float(np.mean([step["valid_fraction"] for step in summary["steps"]]))
    return {"files_s": files, "stages": stages, "valid": valid}


def measure_sequence(
    folder: Path, *, threads: int, suffix: str = "tif", interpolation: str = "cubic", steps: int = 20
) -> SequenceFigures:
    """Measure a sequence of 1200 x 1100 px pairs with 9,900 points, warm, with its stages."""
    files = sequence_files(folder, steps=steps, suffix=suffix)
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    arguments = files.arguments(ROI, out, "--interpolation", interpolation, "--subset", str(SUBSET_PX))
    job = json.dumps({"arguments": arguments, "out": str(out)})
    found = json.loads(run_child([*_ME, "--child", job], threads=threads).output.splitlines()[-1])
    times = found["files_s"]
    step = (times[-1] - times[1]) / (len(times) - 2)
    return SequenceFigures(
        threads,
        suffix,
        interpolation,
        steps,
        POINTS / step,
        step,
        times[1],
        found["valid"],
        {stage: (float(wall), float(cpu)) for stage, (wall, cpu) in found["stages"].items()},
    )


# a fresh process


def first_field(folder: Path, *, steps: int, interpolation: str = "cubic", cache: Path | None = None) -> Used:
    """Measure the reference's shape (``steps`` 0) or it and one displacement (1) by the command line, from its start to its end."""
    files = sequence_files(folder, steps=steps)
    out = folder / f"first_{steps}"
    shutil.rmtree(out, ignore_errors=True)
    arguments = files.arguments(ROI, out, "--interpolation", interpolation)
    return run_child(["-m", "stereorig.server.cli", *arguments], cache=cache)


def cold_compile(folder: Path, interpolation: str = "cubic") -> tuple[Used, Used]:
    """Measure a pair and one step with nothing compiled, and again with all of it on disk."""
    cache = folder / "cache"
    shutil.rmtree(cache, ignore_errors=True)
    return (
        first_field(folder, steps=1, interpolation=interpolation, cache=cache),
        first_field(folder, steps=1, interpolation=interpolation, cache=cache),
    )


# seeds


def _images(files: SequenceFiles, step: int) -> tuple[MeasureImage, MeasureImage]:
    one, two = (MeasureImage(read_image(files.folder / f"{cam}_{step:04d}.{files.suffix}")) for cam in ("cam1", "cam2"))
    return one, two


def measure_seeds(folder: Path, *, threads: int, runs: int = 3) -> list[SeedFigures]:
    """Feature seeds on 2448 x 2048 px with 45,000 points: of a shape, and of a motion from nothing known."""
    files = sequence_files(folder, steps=1, size_px=SEED_SIZE)
    grid = PointGrid.rectangle(60.0, 60.0, SEED_SIZE[0] - 61.0, SEED_SIZE[1] - 61.0, spacing_px=10.0)
    options = MeasureOptions(interpolation="cubic")
    set_threads(threads)
    out = []
    try:
        for what in ("shape", "motion"):
            best: SeedFigures | None = None
            for _ in range(runs):
                found = _seeds_once(files, grid, options, what, threads)
                best = found if best is None or found.wall_s < best.wall_s else best
            assert best is not None
            out.append(best)
    finally:
        set_threads(available_threads())
    return out


def _seeds_once(files: SequenceFiles, grid: PointGrid, options: MeasureOptions, what: str, threads: int) -> SeedFigures:
    inputs = prepare(files.pair, _images(files, 0), _images(files, 1) if what == "motion" else None, grid, options)
    state = begin(inputs)
    start = time.perf_counter(), time.process_time()
    seeds = match_seeds(inputs, state)
    return SeedFigures(what, threads, time.perf_counter() - start[0], time.process_time() - start[1], seeds)


# cost against points


def measure_points(folder: Path, counts: tuple[int, ...], *, threads: int, runs: int = 2) -> list[PointCost]:
    """Fields of growing numbers of points over the same 2448 x 2048 px images, 21 px subsets, images prepared."""
    files = sequence_files(folder, steps=1, size_px=SEED_SIZE)
    current = _images(files, 1)
    options = MeasureOptions(subset_px=21, interpolation="cubic")
    set_threads(threads)
    width, height = SEED_SIZE[0] - 120.0, SEED_SIZE[1] - 120.0
    out = []
    try:
        for count in counts:
            grid = PointGrid.rectangle(
                60.0, 60.0, 60.0 + width, 60.0 + height, spacing_px=(width * height / count) ** 0.5
            )
            best = (np.inf, np.inf, np.inf)
            for _ in range(runs if count < 100_000 else 1):
                reference = _images(files, 0)  # anew, so that its features are found anew
                for image in (*reference, *current):
                    image.prepared("cubic")
                pair = ReferencePair(files.pair, *reference)
                shape_s, shape = _timed(partial(pair.shape, grid, options))
                first_s, first = _timed(partial(pair.motion, *current, grid, options, shape=shape))
                later_s, _ = _timed(partial(pair.motion, *current, grid, options, shape=shape, previous=first))
                best = (min(best[0], shape_s), min(best[1], first_s), min(best[2], later_s))
            out.append(PointCost(grid.x_px.size, *best))
    finally:
        set_threads(available_threads())
    return out


def _timed(work: Callable[[], Field]) -> tuple[float, Field]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


# memory


def memory_of_large_pair(folder: Path, *, steps: int = 0) -> Used:
    """Measure a pair (and ``steps`` later ones) of 24 megapixels with 250,000 points by the command line."""
    files = sequence_files(folder, steps=steps, pictures=max(steps, 1), size_px=LARGE_SIZE)
    width, height = LARGE_SIZE[0] - 121, LARGE_SIZE[1] - 121
    out = folder / "large"
    shutil.rmtree(out, ignore_errors=True)
    step = int((width * height / LARGE_POINTS) ** 0.5)  # whole pixels: some more points rather than fewer
    roi = f"60,60,{60 + width},{60 + height}"
    more = ["--interpolation", "cubic", "--step", str(step)]
    return run_child(["-m", "stereorig.server.cli", *files.arguments(roi, out, *more)])


def memory_of_sequence(folder: Path, steps: int) -> Used:
    """Measure a sequence of so many steps by the command line."""
    files = sequence_files(folder, steps=steps)
    out = folder / f"memory_{steps}"
    shutil.rmtree(out, ignore_errors=True)
    return run_child(["-m", "stereorig.server.cli", *files.arguments(ROI, out, "--interpolation", "cubic")])


_ME = ["-m", "tests.bench.speed.sequence"]


def main() -> int:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer steps, no large images")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help="where to keep rendered images; a temporary folder when left out")
    parser.add_argument("--only", default="", help="some of sequence,fresh,seeds,points,memory")
    args = parser.parse_args()
    if args.child:
        print("\n" + json.dumps(child_sequence(json.loads(args.child))))
        return 0
    from tests.bench.speed.sequence_page import measure_all

    wanted = tuple(name for name in args.only.split(",") if name)
    with tempfile.TemporaryDirectory(prefix="stereorig_bench_") as temporary:
        figures = measure_all(Path(args.folder or temporary), quick=args.quick, only=wanted)
    print("\n".join(row.text() for row in figures.rows()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
