"""Scatter of a line grid's found intersections over repeated pictures, against what each picture claims."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from stereorig.core.grid import GridOptions, detect_grid
from stereorig.core.target import GridTarget
from tests.support.independent_rig import (
    Array,
    LineGrid,
    PlainCamera,
    defocused,
    fine_picture,
    on_sensor,
    with_stray_light,
)

SAMPLES = 8  # of a pixel each way; at 4 the steps of the lines' edges are larger than the noise
GRID = GridTarget(pitch_mm=1.0, lines=(7, 7), line_width_mm=0.1)
CAMERA = PlainCamera(
    (300, 290), 12000.0, 150.0, 145.0, 2.5e-9, 0.9617, np.radians(37.0), 0.01, np.radians(-29.0), 0.0, 0.0, 398.0
)

BLURS: dict[str, Callable[[Array], Array]] = {
    "Gaussian blur": lambda fine: with_stray_light(fine, 0.6 * SAMPLES, SAMPLES, 0.0),
    "defocus, a disc of 1.2 px radius": lambda fine: defocused(fine, 1.2 * SAMPLES, 0.3 * SAMPLES),
    "15 % stray light": lambda fine: with_stray_light(fine, 0.5 * SAMPLES, 2.0 * SAMPLES, 0.15),
}


@functools.cache
def clean_pictures() -> dict[str, Array]:
    """Grey levels without noise under each blur."""
    fine = fine_picture(CAMERA, LineGrid(GRID.pitch_mm, GRID.lines, GRID.line_width_mm), n=SAMPLES)
    return {name: on_sensor(blur(fine), SAMPLES) for name, blur in BLURS.items()}


def photographed(grey: Array, noise: float, rng: np.random.Generator, *, photons: bool) -> Array:
    """Add noise, the same everywhere or, of photons, as the root of the grey level; round to eight bits."""
    sigma = noise * np.sqrt(grey / grey.mean()) if photons else noise
    return np.clip(np.round(grey + sigma * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)


def scatter_over_claim(grey: Array, noise: float, repeats: int, *, photons: bool = False) -> tuple[float, float]:
    """Squared offsets about their means over their covariance along each line, an offset; family a, family b."""
    found, claims = [], []
    for seed in range(repeats):
        picture = photographed(grey, noise, np.random.default_rng([7, seed]), photons=photons)
        view = detect_grid(picture, GRID, options=GridOptions(line_model="local"))
        assert view.line_offsets is not None
        found.append(view.xy_px)
        claims.append(view.line_offsets)
    moved = np.array(found) - np.mean(found, axis=0)
    out = []
    for family in "ab":
        offset = np.sum(moved * getattr(claims[0], f"normal_{family}"), axis=-1)
        lines = offset if family == "a" else offset.swapaxes(1, 2)
        covariance = np.array([getattr(claim, f"covariance_{family}") for claim in claims])
        whitened = np.sum(lines * np.linalg.solve(covariance, lines[..., None])[..., 0])
        out.append(float(whitened / lines.size * repeats / (repeats - 1)))
    return out[0], out[1]
