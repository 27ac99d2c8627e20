"""Conversion of brightness to grey levels: lighting, photons, electrons, the converter.

    electrons = full_well * brightness * exposure / nominal exposure
    grey      = (electrons + shot noise + read noise) / full_well * (2^bits - 1) * 10^(gain_db / 20)

rounded, and clipped to the converter's range. Shot noise is the Gaussian of variance = electrons, which photons follow
to within the read noise from a few dozen electrons up. Noise grows with gain, signal-to-noise with exposure, as in a
real camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Float, Float32


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Noise and converter.

    Attributes
    ----------
    bit_depth
        8 gives uint8 images, 9 to 16 give uint16, right-aligned.
    full_well_e
        Electrons at full scale with no gain.
    read_noise_e
        Standard deviation of the reading, electrons.
    """

    bit_depth: int = 8
    full_well_e: float = 40000.0
    read_noise_e: float = 280.0

    def __post_init__(self) -> None:
        if not 8 <= self.bit_depth <= 16:
            raise ValueError(f"bit_depth must be 8 to 16, got {self.bit_depth}")
        if not (self.full_well_e > 0.0 and self.read_noise_e >= 0.0):
            raise ValueError(f"full well {self.full_well_e} e, read noise {self.read_noise_e} e are not a sensor's")

    @property
    def full_scale(self) -> int:
        """Largest grey level."""
        return (1 << self.bit_depth) - 1

    def noise_sd(self, brightness: ArrayLike, *, exposure: float = 1.0, gain_db: float = 0.0) -> Float:
        """Standard deviation in grey levels, without rounding, at a brightness."""
        electrons = self.full_well_e * np.asarray(brightness, dtype=np.float64) * exposure
        scale = self.full_scale / self.full_well_e * 10.0 ** (gain_db / 20.0)
        return np.asarray(scale * np.sqrt(np.maximum(electrons, 0.0) + self.read_noise_e**2))

    def expose(
        self,
        brightness: NDArray[np.floating],
        rng: np.random.Generator | None,
        *,
        exposure: float = 1.0,
        gain_db: float = 0.0,
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Turn brightness (rows, columns) into an image; ``rng`` None leaves the noise out.

        ``exposure`` is relative to the nominal exposure time, at which brightness 1 is full scale.
        """
        grey: NDArray[np.floating] = brightness * (self.full_scale * exposure * 10.0 ** (gain_db / 20.0))
        if rng is not None:
            sd = self.noise_sd(brightness, exposure=exposure, gain_db=gain_db).astype(np.float32)
            grey = grey + sd * rng.standard_normal(brightness.shape, dtype=np.float32)
        np.clip(np.rint(grey), 0, self.full_scale, out=grey)
        return grey.astype(np.uint8) if self.bit_depth == 8 else grey.astype(np.uint16)


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Uneven light of one camera: ``ambient + gain (1 + g . (u, v)) (1 - vignetting (u^2 + v^2) / 2) brightness``.

    (u, v) run from -1 to 1 across the image. It varies so slowly that it is taken at the pixels' centres.

    Attributes
    ----------
    gain
        Overall.
    vignetting
        Relative loss in the corners.
    gradient
        Relative change from the centre to the right and to the lower edge.
    ambient
        Stray light, of full scale.
    """

    gain: float = 1.0
    vignetting: float = 0.0
    gradient: tuple[float, float] = (0.0, 0.0)
    ambient: float = 0.0

    def apply(self, brightness: NDArray[np.floating]) -> Float32:
        """Light a rendered image (rows, columns)."""
        rows, columns = brightness.shape
        u = np.linspace(-1.0, 1.0, columns)
        v = np.linspace(-1.0, 1.0, rows)[:, None]
        light = self.gain * (1.0 + self.gradient[0] * u + self.gradient[1] * v)
        light = light * (1.0 - 0.5 * self.vignetting * (u * u + v * v))
        return np.asarray(self.ambient + light * brightness, dtype=np.float32)
