"""CPU time of finding targets in images of twelve megapixels, and of a whole calibration from thirty pairs of them.

The pictures are rendered once and kept in a folder. The machine may be busy with other work, so that the process's CPU
time is the figure to compare; the wall time is given beside it::

    python -m tests.bench.speed.targets --folder /tmp/targets --views 30 --kinds checkerboard circles
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stereorig.core.boards import BoardTarget, detect_target, find_target
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.from_folder import calibrate_folder
from stereorig.server.formats.images import read_image
from tests.support.board_views import camera_pair, hand_poses, render_views, sim_target, write_views

SIZE_PX = (4096, 3000)
DISTANCE_MM, FOCAL_PX = 260.0, 7000.0  # 4096 px see 150 mm there
BLUR_PX = 1.0
TARGETS: dict[str, tuple[BoardTarget | GridTarget, dict[str, Any]]] = {
    "checkerboard": (BoardTarget(kind="checkerboard", size=(11, 8), pitch_mm=9.0), {}),
    "charuco": (BoardTarget(kind="charuco", size=(11, 8), pitch_mm=9.0, marker_mm=6.5), {}),
    "circles": (BoardTarget(kind="circles", size=(14, 11), pitch_mm=7.0), {}),
    "circles marked": (BoardTarget(kind="circles", size=(14, 11), pitch_mm=7.0), {"marks": True}),
    "circles_asymmetric": (BoardTarget(kind="circles_asymmetric", size=(7, 13), pitch_mm=6.5), {}),
    "line_grid": (GridTarget(pitch_mm=8.0, lines=(11, 11), line_width_mm=0.8), {}),
}


REPEATS, LEAST_VIEWS = 3, 5


@dataclass(frozen=True)
class Spent:
    """Time of one call, s: of the process on all cores, and on the wall."""

    cpu_s: float
    wall_s: float


def spent(work: Callable[[], object], repeats: int = REPEATS) -> Spent:
    """Return the least of each over some calls; one comes before them, in which kernels are compiled."""
    if repeats > 1:
        work()
    times = []
    for _ in range(repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        times.append((time.process_time() - cpu, time.perf_counter() - wall))
    return Spent(min(cpu for cpu, _ in times), min(wall for _, wall in times))


def pictures(folder: Path, kind: str, views: int) -> Path:
    """Render the pairs that the folder lacks; return the folder of the kind's files."""
    target, faults = TARGETS[kind]
    held = sim_target(target, **faults)
    out = folder / kind.replace(" ", "_")
    cameras = camera_pair(distance_mm=DISTANCE_MM, focal_px=FOCAL_PX, size_px=SIZE_PX)
    for n in range(views):
        name = f"{n:03d}"
        if (out / f"cam2_{name}.tif").exists() and (out / "rig.toml").exists():
            continue
        poses = hand_poses(held, cameras, [n], size_px=SIZE_PX)
        pair = render_views(held, poses, cameras, size_px=SIZE_PX, seed=n, names=[name], blur_px=BLUR_PX)
        write_views(out, pair, held, cameras, moves="free", lens="opencv5")
    return out


def detection(folder: Path, kind: str, pairs: int = 2) -> dict[str, Spent]:
    """Time the fit's detection of an image, and the live one of a pair on two threads, means over some pairs."""
    target, _ = TARGETS[kind]
    images = [[read_image(folder / f"{cam}_{n:03d}.tif") for cam in CAMERAS] for n in range(pairs)]
    precise = [spent(lambda image=image: detect_target(image, target)) for pair in images for image in pair]
    with ThreadPoolExecutor(max_workers=2) as pool:
        live = [
            spent(lambda pair=pair: list(pool.map(lambda image: find_target(image, target), pair))) for pair in images
        ]
    return {"image": mean(precise), "live pair": mean(live)}


def mean(times: Sequence[Spent]) -> Spent:
    """Return the mean of each."""
    return Spent(sum(t.cpu_s for t in times) / len(times), sum(t.wall_s for t in times) / len(times))


def calibration(folder: Path, lens: str) -> tuple[Spent, str]:
    """Time the command's calibration, files included; return the verdict too."""
    rig = folder / f"rig_{lens}.toml"
    rig.write_text((folder / "rig.toml").read_text().replace('lens = "opencv5"', f'lens = "{lens}"'))
    level = ""

    def work() -> None:
        nonlocal level
        found = calibrate_folder(folder, folder / "target.toml", rig)
        level = f"{found.result.verdict.level}, {found.result.lens.model}"
        found.content()

    return spent(work, 1), level


def main(arguments: Sequence[str] | None = None) -> int:
    """Render what lacks, measure, print a table; ``--out`` writes it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "targets_12_megapixels")
    parser.add_argument("--kinds", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--views", type=int, default=2, help="pairs to render; a calibration is timed from five on")
    parser.add_argument("--lenses", nargs="*", default=["opencv5", "auto"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    table: dict[str, dict[str, Any]] = {}
    for kind in options.kinds:
        folder = pictures(options.folder, kind, options.views)
        rows = table[kind] = {name: asdict(s) for name, s in detection(folder, kind).items()}
        if options.views >= LEAST_VIEWS:
            for lens in options.lenses:
                took, verdict = calibration(folder, lens)
                rows[f"{options.views} pairs, {lens}"] = {**asdict(took), "verdict": verdict}
        for name, row in rows.items():
            print(
                f"{kind:20}{name:22}{row['cpu_s']:8.3f} s CPU{row['wall_s']:8.3f} s wall  {row.get('verdict', '')}",
                flush=True,
            )
    if options.out is not None:
        options.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
