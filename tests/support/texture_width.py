"""The width of a texture's covariance, from its formula."""

from __future__ import annotations

import numpy as np

from stereorig.sim.texture import Texture


def two_point_width_mm(texture: Texture, *, pairs: int = 200_000, seed: int = 5) -> float:
    """Full width at half height of the texture's covariance, from random pairs of points of the formula itself."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(-500.0, 500.0, (pairs, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, pairs)
    way = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    here = texture.value(start)
    variance = here.var()
    distances = np.linspace(0.0, 1.0, 101)
    shares = np.array([np.cov(here, texture.value(start + d * way))[0, 1] for d in distances]) / variance
    k = int(np.argmax(shares < 0.5))
    assert k > 0
    a, b = shares[k - 1], shares[k]
    return 2.0 * float(distances[k - 1] + (a - 0.5) / (a - b) * (distances[1] - distances[0]))
