"""The point-level matcher alone: points a second, iterations, and where the time goes.

Images are prepared and start values lie within about a tenth of a pixel, as they do in a sequence, so a figure here is that of
``fit_shape`` and ``fit_motion``, nothing around them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.fit import fit_motion, fit_shape
from stereorig.core.matching.image import ImageData, prepare
from stereorig.core.matching.options import MatchOptions
from stereorig.core.settings import Interpolation
from stereorig.core.threads import set_threads
from tests.bench.accuracy.paper_rig import load_rig, plane_scene

KINDS: tuple[Interpolation, ...] = ("cubic", "quintic")
NEAR, FAR = 5e-6, 6e-5  # relative change of the start values: some 0.05 px, and some 0.7 px


@dataclass(frozen=True)
class KernelScene:
    """A pair before and after a small translation, its points, and what a fit of them found.

    Attributes
    ----------
    pair
        The cameras.
    images
        By interpolation: both cameras at the reference, then both after.
    xy_px
        (N, 2) points.
    w0
        (N,) inverse depths of the plane.
    """

    pair: StereoPair
    images: dict[Interpolation, list[ImageData]]
    xy_px: Float
    w0: Float


@dataclass(frozen=True)
class Rate:
    """Speed of one kind of fit."""

    fit: str
    interpolation: Interpolation
    subset_px: int
    threads: int
    per_second: float
    iterations: float


@dataclass(frozen=True)
class Costs:
    """Where a motion fit's time goes, by least squares over subset sizes and numbers of iterations, one thread.

    ``time = point_us + iteration_us * iterations + pixels * (reference_ns + 3 * loop_ns * iterations)``

    Attributes
    ----------
    interpolation
        Spline.
    point_us, iteration_us
        What does not depend on the number of pixels: once a point, and in each iteration.
    reference_ns
        Per pixel of the subset, once: reading the reference and its sums.
    loop_ns
        Per pixel, image and iteration.
    misfit
        Relative rms of the least-squares fit.
    pixels, iterations, measured_us
        What was fitted.
    """

    interpolation: Interpolation
    point_us: float
    iteration_us: float
    reference_ns: float
    loop_ns: float
    misfit: float
    pixels: Float
    iterations: Float
    measured_us: Float

    def time_us(self, pixels: float, iterations: float) -> float:
        """Return the model's time of a point."""
        return self.overhead_us(iterations) + 1e-3 * pixels * (self.reference_ns + 3.0 * self.loop_ns * iterations)

    def overhead_us(self, iterations: float) -> float:
        """Time of a fit without pixels."""
        return self.point_us + self.iteration_us * iterations


def make_kernel_scene(spacing_px: int = 4) -> KernelScene:
    """Render the paper's rig: 512 x 480 px, 60 degrees, noise 2 of 255."""
    rig = load_rig()
    moved = RigidTransform(np.eye(3), np.array([0.013, -0.007, 0.021]))
    pictures = [
        *rig.capture(plane_scene(rig.texture(1)), seed=1),
        *rig.capture(plane_scene(rig.texture(1), motion=moved), seed=2),
    ]
    images = {kind: [prepare(picture, kind) for picture in pictures] for kind in KINDS}
    xy = PointGrid.rectangle(60, 60, 450, 420, spacing_px=spacing_px).xy_px.reshape(-1, 2)
    depth = rig.pair.cam1.cam_from_sys.apply(rig.pair.cam1.back_project_to_plane(xy).xyz_mm)[:, 2]
    return KernelScene(rig.pair, images, xy, 1.0 / depth)


@dataclass(frozen=True)
class Fitted:
    """Points that can be measured at a subset size, and their solution."""

    xy_px: Float
    w: Float
    G: Float
    options: MatchOptions


def solve_first(scene: KernelScene, interpolation: Interpolation, subset_px: int, points: int | None = None) -> Fitted:
    """Measure the points once from the plane's depth, so that starts at a known distance can be made."""
    options = MatchOptions(subset_px=subset_px, interpolation=interpolation)
    images = scene.images[interpolation]
    every = slice(None, None, 1 if points is None else max(1, len(scene.xy_px) // points))
    xy = np.ascontiguousarray(scene.xy_px[every])
    w = np.zeros((len(xy), 3))
    w[:, 0] = scene.w0[every]
    shape = fit_shape(scene.pair, images[0], images[1], xy, w, options)
    xy, w = xy[shape.status == 0], shape.w[shape.status == 0]
    motion = fit_motion(scene.pair, *images, xy, w, None, options)
    ok = motion.status == 0
    if not ok.any():
        raise RuntimeError("no point of the bench's scene was measured")
    return Fitted(xy[ok], motion.w[ok], motion.G[ok], options)


def shifted(fitted: Fitted, away: float) -> tuple[Float, Float]:
    """Start values some way from the solution."""
    w = fitted.w.copy()
    w[:, 0] *= 1.0 + 2.0 * away
    return w, fitted.G * (1.0 + away)


def best_time(work: Callable[[], object], runs: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Shortest of several runs, after one to warm up, s."""
    work()
    times = []
    for _ in range(runs):
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)


def measure_rates(scene: KernelScene, threads: int, runs: int) -> tuple[list[Rate], dict[str, NDArray[np.int32]]]:
    """Points a second of shape and motion at 21 and 33 px; and the iterations of each motion fit by its name."""
    set_threads(threads)
    rates, counts = [], {}
    for kind in KINDS:
        images = scene.images[kind]
        for subset in (21, 33):
            fitted = solve_first(scene, kind, subset)
            w, G = shifted(fitted, NEAR)
            shape = partial(fit_shape, scene.pair, images[0], images[1], fitted.xy_px, w, fitted.options)
            motion = partial(fit_motion, scene.pair, *images, fitted.xy_px, w, G, fitted.options)
            for name, fit in (("shape", shape), ("motion", motion)):
                spent = fit().iterations
                rates.append(Rate(name, kind, subset, threads, len(w) / best_time(fit, runs), float(spent.mean())))
                counts[f"{name}, {kind}, {subset} px"] = spent
            w, G = shifted(fitted, FAR)
            far = fit_motion(scene.pair, *images, fitted.xy_px, w, G, fitted.options)
            counts[f"motion, {kind}, {subset} px, far start"] = far.iterations
    return rates, counts


def measure_costs(scene: KernelScene, interpolation: Interpolation, runs: int, points: int = 1500) -> Costs:
    """Fit the model of :class:`Costs` to CPU times on one thread."""
    set_threads(1)
    images = scene.images[interpolation]
    rows, times = [], []
    for subset in (9, 13, 17, 21, 25, 29, 33, 37, 41):
        fitted = solve_first(scene, interpolation, subset, points)
        for away in (NEAR, FAR):
            w, G = shifted(fitted, away)
            fit = partial(fit_motion, scene.pair, *images, fitted.xy_px, w, G, fitted.options)
            spent = float(fit().iterations.mean())
            took = 1e6 * best_time(fit, runs, time.process_time) / len(w)
            n = float(subset**2)
            rows.append([1.0, spent, 1e-3 * n, 3e-3 * n * spent])
            times.append(took)
    A, b = np.array(rows), np.array(times)
    # relative errors, so that small subsets count as much as large ones
    x, _ = nnls(A / b[:, None], np.ones(len(b)))
    misfit = float(np.sqrt(np.mean((A @ x / b - 1.0) ** 2)))
    return Costs(interpolation, x[0], x[1], x[2], x[3], misfit, A[:, 2] * 1e3, A[:, 1], b)
