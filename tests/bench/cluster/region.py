"""Measures one large step split by region: processor time of the busiest of one and two workers, and what limits more.

Run from the repository's root; writes its section of docs/explanation/cluster.md::

    python -m tests.bench.cluster.region [--size W H] [--spacing PX] [--pictures FOLDER] [--dry]
"""

from __future__ import annotations

import argparse
import heapq
import json
import logging
import re
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from core.field.points.fitter import PointFits
from core.settings import SplitStep, StoredSettings
from server.compute.tiles.folder_crew import FITTED
from server.formats.files import sha256_of
from server.worker.embedded import ComputeWorker
from server.worker.executor import TaskFuture
from server.worker.helpers import Helpers
from server.worker.pool import WorkerPool
from server.worker.tasks import StepImages, StepTask, measure_step
from server.worker.tile_task import TileTask
from tests.bench.cluster.region_page import write_section
from tests.bench.speed.scene import sequence_files

STEPS = {0: "shape", 1: "first motion", 2: "further step"}
WORKERS = (1, 2, 4, 8, 16)
SUBSET_PX = 33
_FITTED = re.compile(
    re.escape(FITTED).replace("%d", "([0-9]+)", 1).replace("%d", "[0-9]+").replace(re.escape("%.3f"), "([0-9.]+)")
)
_WARM_UP = "server.compute.measurement:compile_here"


@dataclass
class Spent:
    """Processor time of one step, s.

    Attributes
    ----------
    own_s, others_s
        Of the worker that measures it, and of the one that helps.
    tiles, elsewhere
        How many there were, and how many of them the helper fitted in time.
    tiles_s
        Of its own, of the worker that measures it, for the tiles: writing them, and fitting those that it took.
    tile_bytes
        Written for a tile, on average.
    """

    own_s: float
    others_s: float = 0.0
    tiles: int = 0
    elsewhere: int = 0
    tiles_s: float = 0.0
    tile_bytes: float = 0.0

    @property
    def busiest_s(self) -> float:
        """Of the busiest worker."""
        return max(self.own_s, self.others_s)

    @property
    def a_tile_s(self) -> float:
        """Of the worker that measures it, for a tile that it fits itself."""
        return self.tiles_s / max(self.tiles - self.elsewhere, 1)

    @property
    def alone_s(self) -> float:
        """What it would have taken alone, by the same run."""
        return self.own_s - self.tiles_s + self.a_tile_s * self.tiles


@dataclass
class Figures:
    """What the section shows: by step, spent in one piece, by one worker and by two; and times faster by workers."""

    size_px: tuple[int, int]
    points: int
    whole: list[Spent]
    alone: list[Spent]
    two: list[Spent]
    same: bool
    fits_bytes: int
    simulated: dict[int, list[float]]


class Bench:
    """Workers, and a test of three steps.

    Parameters
    ----------
    workers
        Each of one thread.
    files
        Folder of the images and of ``calibration.json``.
    """

    def __init__(self, workers: int, files: Path) -> None:
        self._files = files
        logging.getLogger().setLevel(logging.INFO)  # as it is when they start, workers send what they log
        self._workers = [ComputeWorker(threads=1, warm_up=_WARM_UP, lowered=False) for _ in range(workers)]
        self._pool = WorkerPool(self._workers)
        for worker in self._workers:
            worker.start()
        for worker in self._workers:
            if not worker.ready.wait(300):
                raise RuntimeError("a worker does not start")
        self._logged: list[re.Match[str]] = []
        logger = logging.getLogger("stereorig.tiles")
        logger.setLevel(logging.INFO)
        logger.addFilter(self._note)
        self._processes = [psutil.Process(worker.pid) for worker in self._workers]

    def _note(self, record: logging.LogRecord) -> bool:
        found = _FITTED.fullmatch(record.getMessage())
        if found is not None:
            self._logged.append(found)
        return True

    def close(self) -> None:
        """End the workers."""
        logging.getLogger("stereorig.tiles").removeFilter(self._note)
        self._pool.shutdown()

    def measure(self, folder: Path, region: tuple[int, ...], spacing_px: int, split: SplitStep) -> list[Spent]:
        """Measure the test; return what each step took."""
        settings = StoredSettings.model_validate(
            {"region": {"rectangle": region}, "subset_px": SUBSET_PX, "spacing_px": spacing_px, "split_step": split}
        )
        folder.mkdir()
        return [self._step(folder, settings, n) for n in STEPS]

    def _step(self, folder: Path, settings: StoredSettings, n: int) -> Spent:
        task = StepTask(
            folder=folder,
            calibration=self._files / "calibration.json",
            settings=settings,
            reference=self._images(0),
            step=self._images(n),
            previous=None if n == 0 else n - 1,
            earlier={k: self._images(k) for k in range(1, n)},
            shares=len(self._workers) > 1,
        )
        called: list[tuple[TileTask, float]] = []
        helping: list[TaskFuture] = []
        submit: Callable[..., TaskFuture] = self._pool.submit
        helpers = Helpers(self._pool)

        def noted(function: Any, *args: Any) -> TaskFuture:
            helping.append(submit(function, *args))
            return helping[-1]

        self._logged.clear()
        before = [_busy_s(p) for p in self._processes]
        future = submit(measure_step, task)
        helpers.hear(future)
        hear = future.on_call
        assert hear is not None

        def on_call(tiles: TileTask) -> None:
            sizes = [path.stat().st_size for path in tiles.folder.glob("tile_*")]
            called.append((tiles, float(np.mean(sizes))))
            hear(tiles)

        future.on_call = on_call
        self._pool.submit = noted  # type: ignore[method-assign]
        try:
            while not future.done():
                helpers.look(busy=1)
                wait([future], timeout=0.02)
        finally:
            self._pool.submit = submit  # type: ignore[method-assign]
        future.result()
        for one in helping:
            one.result(timeout=60)
        time.sleep(0.3)  # a process' clock goes in hundredths
        used = [_busy_s(p) - b for p, b in zip(self._processes, before, strict=True)]
        return Spent(
            used[0],
            max(used[1:], default=0.0),
            sum(tiles.tiles for tiles, _ in called),
            sum(int(found[1]) for found in self._logged),
            sum(float(found[2]) for found in self._logged),
            float(np.mean([size for _, size in called])) if called else 0.0,
        )

    def _images(self, n: int) -> StepImages:
        one, two = (self._files / f"{cam}_{n:04d}.tif" for cam in ("cam1", "cam2"))
        return StepImages(n=n, files=(one, two), sha256=(sha256_of(one), sha256_of(two)))


def _busy_s(process: psutil.Process) -> float:
    return float(sum(process.cpu_times()[:2]))


def times_faster(two: Spent, workers: int) -> float:
    """Return how many times faster a step is by more workers: its parts as two took them, whoever is free takes a tile."""
    if two.elsewhere == 0 or workers == 1:
        return 1.0
    free = [(0.0, two.a_tile_s), *((0.0, two.others_s / two.elsewhere) for _ in range(workers - 1))]
    heapq.heapify(free)
    for _ in range(two.tiles):
        at, cost = heapq.heappop(free)
        heapq.heappush(free, (at + cost, cost))
    return two.alone_s / (two.own_s - two.tiles_s + max(at for at, _ in free))


def same_results(one: Path, two: Path) -> bool:
    """Return True if the result files of two measurements have the same numbers, to the last bit."""
    from tests.support.running_analyses import contents

    for n in STEPS:
        a, b = (contents(folder / f"step_{n:04d}.nc") for folder in (one, two))
        if a.keys() != b.keys() or not all(np.array_equal(a[k], b[k], equal_nan=a[k].dtype.kind == "f") for k in a):
            return False
    return True


def _printed(path: Path) -> Figures:
    found: dict[str, Any] = json.loads(path.read_text())
    spent = {name: [Spent(**one) for one in found[name]] for name in ("whole", "alone", "two")}
    simulated = {workers: [times_faster(step, workers) for step in spent["two"]] for workers in WORKERS}
    return Figures(**{**found, **spent, "size_px": tuple(found["size_px"]), "simulated": simulated})


def main() -> int:
    """Measure, simulate, write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs=2, default=(3000, 2000), help="of the images, px")
    parser.add_argument("--spacing", type=int, default=8, help="distance of points, px")
    parser.add_argument("--pictures", type=Path, help="where rendered images are kept")
    parser.add_argument("--dry", action="store_true", help="print the figures, write no page")
    parser.add_argument("--figures", type=Path, help="write the page from figures that were printed before")
    args = parser.parse_args()
    if args.figures is not None:
        write_section(_printed(args.figures), list(STEPS.values()))
        return 0
    size = (args.size[0], args.size[1])
    region = tuple(round(share * side) for share, side in zip((0.1, 0.125, 0.9, 0.875), size * 2, strict=True))
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        pictures = args.pictures or out / "pictures"
        files = sequence_files(pictures, steps=2, pictures=2, size_px=size).folder
        found: dict[str, list[Spent]] = {}
        for workers in (1, 2):
            bench = Bench(workers, files)
            try:
                bench.measure(out / f"warm{workers}", (*region[:2], region[0] + 600, region[1] + 400), 4, "always")
                if workers == 1:
                    found["whole"] = bench.measure(out / "whole", region, args.spacing, "never")
                found[str(workers)] = bench.measure(out / str(workers), region, args.spacing, "auto")
            finally:
                bench.close()
        same = same_results(out / "1", out / "2")
    one, two = found["1"], found["2"]
    point = PointFits.empty(1, 3)
    figures = Figures(
        size_px=size,
        points=(int((region[2] - region[0]) // args.spacing) + 1) * (int((region[3] - region[1]) // args.spacing) + 1),
        whole=found["whole"],
        alone=one,
        two=two,
        same=same,
        fits_bytes=sum(a.nbytes for f in fields(point) if (a := getattr(point, f.name)) is not None),
        simulated={w: [times_faster(step, w) for step in two] for w in WORKERS},
    )
    print(json.dumps(asdict(figures)), flush=True)
    if not args.dry:
        write_section(figures, list(STEPS.values()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
