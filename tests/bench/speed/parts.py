"""What the parts of one motion fit cost, each timed alone in a compiled loop on a real point of the bench's scene.

The parts are the kernel's own functions (``core/matching/kernels``); what is left of the fit's time is what lies between
them: tests, updates, correlations, covariances, results, and memory that is not in the first cache.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from stereorig.core.matching.arguments import reference_of
from stereorig.core.matching.image import PAD
from stereorig.core.matching.kernels.linear import covariance_of_last, solve
from stereorig.core.matching.kernels.loops import LANES, compare_cubic, compare_quintic, sum_reference
from stereorig.core.matching.kernels.point import make_point
from stereorig.core.matching.kernels.warp import lens_jacobian, set_up_warp
from stereorig.core.matching.options import SPLINE_ORDER
from stereorig.core.settings import Interpolation
from tests.bench.speed.kernel import KernelScene

DEGREE = 1  # plane patches
_UNKNOWNS = 13
_MIN_S = 0.01
_REPEATS = 7


@dataclass(frozen=True)
class Parts:
    """us of each part, once: one point, one image or one solution, whichever the part is about.

    Attributes
    ----------
    interpolation, subset_px
        What was timed.
    reference_us, gram_us
        The reference's set-up as a whole, and of it the sums for the normal equations.
    warp_us, loop_us
        Warp and pixel loop of one image.
    jacobian_us, assemble_us
        Of all three images, and the normal equations from them.
    factor_us, solve_us, covariance_us
        Of the 13 unknowns.
    step_us
        Right-hand side, and how far a step moves the patch.
    """

    interpolation: Interpolation
    subset_px: int
    reference_us: float
    gram_us: float
    warp_us: float
    loop_us: float
    jacobian_us: float
    assemble_us: float
    factor_us: float
    solve_us: float
    covariance_us: float
    step_us: float

    @property
    def loop_ns(self) -> float:
        """Pixel loop, ns a pixel and image."""
        return 1e3 * self.loop_us / self.subset_px**2

    def split_us(self, total_us: float, iterations: float) -> dict[str, float]:
        """Share out a fit's time; three images in each iteration."""
        known = {
            "reference: copy, rays": self.reference_us - self.gram_us,
            "reference: Gram sums": self.gram_us,
            "warp set-up": 3.0 * iterations * self.warp_us,
            "pixel loop": 3.0 * iterations * self.loop_us,
            "Jacobian, normal equations": self.jacobian_us + self.assemble_us,
            "right-hand sides, moves": iterations * self.step_us,
            "factor, solve, covariance": self.factor_us + iterations * self.solve_us + self.covariance_us,
        }
        return {**known, "the rest": max(0.0, total_us - sum(known.values()))}


@cache
def _timers(order: int) -> dict[str, Any]:
    """Compiled loops around the parts."""
    parts = make_point(DEGREE, 3)
    set_up_reference, jacobian, assemble = parts.set_up_reference, parts.jacobian, parts.assemble
    factor, gradient, moves_of = parts.factor, parts.gradient, parts.moves_of
    sums_of, compare = sum_reference[DEGREE], (compare_cubic if order == 3 else compare_quintic)[DEGREE]
    lead = order // 2

    everything = np.zeros((0, 1, 1), np.uint8)

    @njit(nogil=True, error_model="numpy")
    def reference(n, images, lens, x, y, subset, ref, space):
        total = 0.0
        for _ in range(n):
            total += set_up_reference(images, everything, -1, lens, x, y, subset, ref, space).f2
        return total

    @njit(nogil=True, error_model="numpy")
    def gram(n, ref, blocks, raw):
        for _ in range(n):
            sums_of(ref, np.int64(blocks), np.float32(0.0), raw)
        return raw[0]

    @njit(nogil=True, error_model="numpy")
    def warp(n, lens, m, powers, rows, cols, stride, work, p):
        base = 0
        for _ in range(n):
            base += set_up_warp(lens, m, powers, rows, cols, stride, lead, work, p)
        return base

    @njit(nogil=True, error_model="numpy")
    def loop(n, coefficients, base, stride, p, ref, blocks, out):
        for _ in range(n):
            compare(coefficients, np.int64(base), np.int64(stride), p, ref, np.int64(blocks), out)
        return out[0]

    @njit(nogil=True, error_model="numpy")
    def jacobians(n, R, t, M, slopes, of_reference, inverse, equations):
        ok = True
        for _ in range(n):
            ok &= jacobian(R, t, 0.0, 1e-5, 1e-5, M, slopes, of_reference, inverse, equations.block, equations.columns)
        return ok

    @njit(nogil=True, error_model="numpy")
    def assembles(n, equations, gram):
        for _ in range(n):
            assemble(equations, gram)
        return equations.normal[0, 0]

    @njit(nogil=True, error_model="numpy")
    def steps(n, equations, rhs, small, moves):
        total = 0.0
        for _ in range(n):
            gradient(equations, rhs, small)
            total += moves_of(equations.columns, small, moves)
        return total

    @njit(nogil=True, error_model="numpy")
    def factors(n, normal, work):
        for _ in range(n):
            work[:] = normal
            factor(work, _UNKNOWNS)
        return work[0, 0]

    @njit(nogil=True, error_model="numpy")
    def solves(n, u, b, x):
        for _ in range(n):
            x[:] = b
            solve(u, x, _UNKNOWNS)
        return x[0]

    @njit(nogil=True, error_model="numpy")
    def covariances(n, u, work, out):
        for _ in range(n):
            covariance_of_last(u, _UNKNOWNS, 5, work, out)
        return out[0]

    return {
        "work_space": parts.work_space,
        "jacobian": jacobians,
        "assemble": assembles,
        "step": steps,
        "reference": reference,
        "gram": gram,
        "warp": warp,
        "loop": loop,
        "factor": factors,
        "solve": solves,
        "covariance": covariances,
    }


def _us(call: Callable[[int], object]) -> float:
    """us of one turn, best of several runs."""
    n = 1
    call(n)
    while True:
        start = time.perf_counter()
        call(n)
        if time.perf_counter() - start > _MIN_S:
            break
        n *= 2
    best = np.inf
    for _ in range(_REPEATS):
        start = time.perf_counter()
        call(n)
        best = min(best, time.perf_counter() - start)
    return 1e6 * float(best) / n


def measure_parts(scene: KernelScene, interpolation: Interpolation, subset_px: int) -> Parts:
    """Time the parts at the middle point of the scene, seen by camera 2 at the plane's depth and slope zero."""
    run = _timers(SPLINE_ORDER[interpolation])
    images = scene.images[interpolation]
    middle = len(scene.xy_px) // 2
    x, y = scene.xy_px[middle]
    lens1, lens2 = (np.array(c.lens.kernel_parameters()) for c in (scene.pair.cam1, scene.pair.cam2))
    pictures = reference_of(images[0])
    space = run["work_space"](subset_px)
    ref, of_reference, rhs, M, equations = space.ref, space.of_reference, space.rhs, space.M, space.equations
    moves, vectors, inverse = space.moves, space.vectors, space.inverse
    raw, powers, gram = of_reference.raw, of_reference.powers, of_reference.gram
    reference_us = _us(lambda n: run["reference"](n, pictures, lens1, x, y, subset_px, ref, of_reference))
    blocks = (subset_px**2 + LANES - 1) // LANES
    gram_us = _us(lambda n: run["gram"](n, ref, blocks, raw))
    pose = scene.pair.cam2_from_cam1
    R, t = np.array(pose.rotation), np.array(pose.translation_mm)
    xc, yc, _ = scene.pair.cam1.rays_cam(np.array([x, y])).xyz_mm
    M[1] = [[xc, 1.0, 0.0], [yc, 0.0, 1.0], [1.0, 0.0, 0.0]]
    M[0] = M[2] = R @ M[1] + np.outer(t, [scene.w0[middle], 0.0, 0.0])
    rows, cols = images[1].shape
    stride = cols + 2 * PAD
    p, work, sums = space.warp
    p[20] = 1.0
    base = run["warp"](1, lens2, M[0], powers, rows, cols, stride, work, p)
    if base < 0:
        raise RuntimeError("the bench's point is not in camera 2's picture")
    warp_us = _us(lambda n: run["warp"](n, lens2, M[0], powers, rows, cols, stride, work, p))
    flat = images[1].coefficients.ravel()
    loop_us = _us(lambda n: run["loop"](n, flat, base, stride, p, ref, blocks, sums))
    slopes = lens_jacobian(lens1, xc, yc)
    jacobian_us = _us(lambda n: run["jacobian"](n, R, t, M, slopes, of_reference, inverse, equations))
    equations.weights[:3, :3] = (
        1.5 * np.eye(3) - 0.4
    )  # inverse covariance of comparisons that share the reference's noise
    assemble_us = _us(lambda n: run["assemble"](n, equations, gram))
    normal = equations.normal.copy()
    factor_us = _us(lambda n: run["factor"](n, normal, equations.normal))
    rhs[:] = 1.0
    step_us = _us(lambda n: run["step"](n, equations, rhs, vectors[2], moves))
    solve_us = _us(lambda n: run["solve"](n, equations.normal, vectors[2], vectors[3]))
    few, out = np.empty((5, 5)), np.empty(25)
    covariance_us = _us(lambda n: run["covariance"](n, equations.normal, few, out))
    if not np.isfinite(out).all():
        raise RuntimeError("the bench's normal equations cannot be solved")
    return Parts(
        interpolation,
        subset_px,
        reference_us,
        gram_us,
        warp_us,
        loop_us,
        jacobian_us,
        assemble_us,
        factor_us,
        solve_us,
        covariance_us,
        step_us,
    )
