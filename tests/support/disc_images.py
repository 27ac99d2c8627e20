"""Images of sharp discs, by counting samples inside them: no blur, no interpolation, nothing of the matching."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair


@njit(cache=True, nogil=True)
def _cover(image, centres, radii, samples, aperture):
    rows, cols = image.shape
    for k in range(len(radii)):
        x, y, r = centres[k, 0], centres[k, 1], radii[k]
        for i in range(max(0, int(y - r) - 2), min(rows, int(y + r) + 3)):
            for j in range(max(0, int(x - r) - 2), min(cols, int(x + r) + 3)):
                inside = 0
                for a in range(samples):
                    for b in range(samples):
                        px = j + aperture * ((b + 0.5) / samples - 0.5) - x
                        py = i + aperture * ((a + 0.5) / samples - 0.5) - y
                        if px * px + py * py < r * r:
                            inside += 1
                image[i, j] = max(image[i, j], inside / samples**2)


def discs(
    size: int,
    seed: int,
    *,
    shift_px: float = 0.0,
    radius_px: float = 2.5,
    aperture_px: float = 1.0,
    noise_grey: float = 2.0,
    samples: int = 8,
) -> NDArray[np.uint8]:
    """Return (size, size) grey levels of white discs that cover half of a dark ground, moved along x.

    ``aperture_px`` is the side of the square that a pixel integrates: 1 as sensors do, 2 as behind a soft lens. The
    noise is drawn anew with each shift.
    """
    rng = np.random.default_rng(seed)
    count = int(0.5 * (size + 40) ** 2 / (np.pi * radius_px**2))
    centres = rng.uniform(-20.0, size + 20.0, (count, 2)) + np.array([shift_px, 0.0])
    radii = radius_px * rng.uniform(0.8, 1.2, count)
    cover = np.zeros((size, size))
    _cover(cover, centres, radii, samples, aperture_px)
    noise = np.random.default_rng([seed, round(1e4 * (shift_px + 100.0))]).normal(0.0, noise_grey, cover.shape)
    return np.clip(np.rint(40.0 + 170.0 * cover + noise), 0, 255).astype(np.uint8)


def cameras_beside(size: int) -> StereoPair:
    """Two cameras of (size, size) px side by side, square to a plane at 100 mm: camera 2 sees it 6 px further left."""
    alike = {
        "phd_px": 1000.0,
        "cx_px": size / 2.0,
        "cy_px": size / 2.0,
        "kappa_per_px2": 0.0,
        "aspect": 1.0,
        "alpha_rad": 0.0,
        "beta_rad": 0.0,
        "gamma_rad": 0.0,
        "y0_mm": 0.0,
        "z0_mm": 100.0,
    }
    return StereoPair(Camera.from_paper(**alike, x0_mm=0.0), Camera.from_paper(**alike, x0_mm=-0.6))
