"""Speed on a flat field, over that of the code before the work on faces: both in turn, in processes of their own.

The code before is taken from the repository's history into a folder that is removed afterwards; its kernels are compiled
there once, a minute.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.names import CAMERAS
from tests.bench.accuracy.table import Row, Section
from tests.bench.speed.scene import SequenceFiles, sequence_files
from tests.support.requirements import ROOT

COMMIT = "b6816770"
_ROI = "60,60,1050,1040"
_PAIRS = {1: 10, 2: 6}  # of processes, by number of processors
_MAX_RATIO = 1.03
# measures again and again in one process: the first pays for imports and for loading kernels
_CHILD = """
import json, os, shutil, sys, time
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:int(sys.argv[1])])
out, arguments = sys.argv[2], sys.argv[3:]
from stereorig.server.cli import main
times = []
for _ in range(4):
    shutil.rmtree(out, ignore_errors=True)
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        main(arguments)
    except SystemExit as end:
        assert not end.code, end.code
    times.append((time.perf_counter() - wall, time.process_time() - cpu))
print(json.dumps([min(column) for column in zip(*times[1:])]), file=sys.stderr)
"""


@dataclass(frozen=True)
class Taken:
    """Seconds of one measurement, best of three: by the clock, and of the processor."""

    wall_s: float
    cpu_s: float


@contextmanager
def code_before(folder: Path) -> Iterator[Path]:
    """The code before, in a folder of its own."""
    tree = folder / "before"
    subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), COMMIT], cwd=ROOT, check=True)
    try:
        yield tree
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)


def taken(tree: Path, files: SequenceFiles, processors: int, folder: Path) -> Taken:
    """Measure shape and first displacement with the code of a folder, on so many processors."""
    environment = os.environ | {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(folder / f"kernels_{tree.name}")}
    out = folder / "out"
    command = [sys.executable, "-c", _CHILD, str(processors), str(out), *files.arguments(_ROI, out)]
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=True)
    return Taken(*json.loads(done.stderr.splitlines()[-1]))


def speed_on_a_flat_field(_: Path) -> Section:
    """Measure a flat plate with both in turn."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name, code_before(Path(name)) as before:
        folder = Path(name)
        files = sequence_files(folder, steps=1)
        calibration = files.folder / "calibration.json"  # without a covariance, which the code before knew nothing of
        cameras = {cam: camera for cam, camera in json.loads(calibration.read_text()).items() if cam in CAMERAS}
        calibration.write_text(json.dumps(cameras))
        trees = {"before": before, "now": ROOT}
        for tree in trees.values():
            taken(tree, files, 2, folder)  # compiles
        for processors, pairs in _PAIRS.items():
            found: dict[str, list[Taken]] = {"before": [], "now": []}
            for pair in range(pairs):
                for when in ("before", "now") if pair % 2 == 0 else ("now", "before"):
                    found[when].append(taken(trees[when], files, processors, folder))
            for what in ("wall_s", "cpu_s"):
                old, new = ([getattr(one, what) for one in found[when]] for when in ("before", "now"))
                clock = "by the clock" if what == "wall_s" else "of the processors"
                where = f"{processors} processor{'s' if processors > 1 else ''}, {pairs} pairs: time {clock}"
                ratio = statistics.median(new) / statistics.median(old)
                rows.append(Row(f"{where}, now over before, of medians", ratio, "", _MAX_RATIO))
                rows.append(Row("the same, of the least", min(new) / min(old), ""))
            print(f"{processors}: {found}")
    return Section(
        "Speed on a flat field",
        f"`stereorig measure` on a flat plate with every point right, 9,900 points, 33 px: reference and first "
        f"displacement, in warm processes of the code before the work on faces (commit {COMMIT}) and of today's, in turn.",
        rows,
        [],
        [],
    )


SECTIONS = {"faces-speed": speed_on_a_flat_field}
