"""Time the matching on this machine: ``make bench``. Nothing here passes or fails.

Points per second of the point-level matcher (start values within a tenth of a pixel, images prepared) and of a whole
field (seeds, growth, checks), at one and at two threads, cubic and quintic, best and median of several runs. Ratios between rows
of one run are worth more than the figures themselves: machines and their neighbours differ.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from core.camera import RigidTransform
from core.field.region import PointGrid
from core.matching.fit import fit_motion, fit_shape
from core.matching.image import prepare
from core.matching.options import Interpolation, MatchOptions
from core.measure import MeasureOptions, ReferencePair
from core.threads import available_threads, set_threads
from docs.scripts.paper_rig import load_rig, plane_scene


def _rate(points: int, work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Best and median points per second."""
    work()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return points / min(times), points / statistics.median(times)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    args = parser.parse_args()
    rig = load_rig()
    before = plane_scene(rig.texture(1))
    after = plane_scene(rig.texture(1), motion=RigidTransform(np.eye(3), np.array([0.013, -0.007, 0.021])))
    ref, cur = rig.shoot(before, seed=1), rig.shoot(after, seed=2)
    grid = PointGrid.rectangle(60, 60, 450, 420, step_px=4)
    xy = grid.xy_px.reshape(-1, 2)
    depth = rig.pair.cam1.cam_from_sys.apply(rig.pair.cam1.back_project_to_plane(xy).xyz_mm)
    print(f"{len(xy)} points, 512 x 480 px, noise 2 of 255, {available_threads()} thread(s) available")
    print(f"{'':34s}{'threads':>8s}{'best / s':>12s}{'median / s':>12s}{'us a point':>12s}")
    for kind in ("cubic", "quintic"):
        interpolation: Interpolation = kind  # type: ignore[assignment]
        images = [prepare(image, interpolation) for image in (*ref, *cur)]
        for subset in (21, 33):
            options = MatchOptions(subset_px=subset, interpolation=interpolation)
            # start values: the plane's inverse depth, an eighth of a pixel away
            w = np.zeros((len(xy), 3))
            w[:, 0] = 1.0 / depth[:, 2]
            first = fit_shape(rig.pair, images[0], images[1], xy, w, options)
            usable = first.status == 0
            here, w = xy[usable], first.w[usable]
            moved = fit_motion(rig.pair, *images, here, w, None, options)
            ok = moved.status == 0
            here, w, G = here[ok], w[ok], moved.G[ok]
            w[:, 0] *= 1.0 + 1e-5
            G = G * (1.0 + 5e-6)
            for threads in range(1, available_threads() + 1):
                set_threads(threads)
                shape = _rate(
                    len(here), partial(fit_shape, rig.pair, images[0], images[1], here, w, options), args.runs
                )
                motion = _rate(len(here), partial(fit_motion, rig.pair, *images, here, w, G, options), args.runs)
                for name, (best, median) in (("shape", shape), ("motion, 3 comparisons", motion)):
                    label = f"{name}, {kind}, {subset} px"
                    print(f"{label:34s}{threads:8d}{best:12.0f}{median:12.0f}{1e6 * threads / best:12.1f}")
        options33 = MeasureOptions(subset_px=33, interpolation=interpolation)
        field_grid = PointGrid.rectangle(60, 60, 450, 420, step_px=5)
        n = field_grid.x_px.size
        reference = ReferencePair(rig.pair, *ref)
        shape_field = reference.shape(field_grid, options33)
        for threads in range(1, available_threads() + 1):
            set_threads(threads)
            previous = reference.motion(*cur, field_grid, options33, shape=shape_field)
            first_step = _rate(n, partial(reference.motion, *cur, field_grid, options33, shape=shape_field), args.runs)
            later = _rate(
                n,
                partial(reference.motion, *cur, field_grid, options33, shape=shape_field, previous=previous),
                args.runs,
            )
            for name, (best, median) in (("field, first step", first_step), ("field, later step", later)):
                print(
                    f"{name + ', ' + kind + ', 33 px':34s}{threads:8d}{best:12.0f}{median:12.0f}{1e6 * threads / best:12.1f}"
                )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
