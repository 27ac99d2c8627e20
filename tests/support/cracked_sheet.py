"""A sheet with a centre crack: the closed form of its displacements, and fields as a measurement would have them.

Muskhelishvili's potentials of an infinite sheet with a straight crack |x| < a, y = 0, under remote tension S across the
crack, tension X along it and shear Q:

    2 G (u + i v) = kappa phi(z) - omega(z*) - (z - z*) phi'(z)*,
    phi = p (sqrt(z^2 - a^2) - z) + (S + X) z / 4,  omega = phi with the uniform part's own,   p = (S - i Q) / 2,

    K_I = S sqrt(pi a),  K_II = Q sqrt(pi a),  T = X - S,  J = (K_I^2 + K_II^2) / E.

Neither the series nor any code that is tested is used. A subset's displacement is the mean over its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from tests.support.gauge_field import SUBSET, make_field, pixel_noise

E_MPA, NU = 73_100.0, 0.33
MM_PER_PX = 0.1
SIGMA_MM = 3e-4


@dataclass(frozen=True)
class Sheet:
    """Half length of the crack in mm, remote stresses in MPa; the middle in the image, px; direction of the crack."""

    half_mm: float = 20.0
    tension: float = 80.0
    shear: float = 0.0
    along: float = 0.0
    turn_rad: float = 0.0

    @property
    def k(self) -> tuple[float, float]:
        """K_I, K_II in MPa sqrt(mm)."""
        root = float(np.sqrt(np.pi * self.half_mm))
        return self.tension * root, self.shear * root

    @property
    def j(self) -> float:
        """J in N/mm."""
        return float(np.hypot(*self.k)) ** 2 / E_MPA

    def displacement(self, xy_mm: Float) -> Float:
        """(..., 2) at positions from the crack's middle, in plane stress."""
        turn = np.exp(1j * self.turn_rad)
        z = (xy_mm[..., 0] + 1j * xy_mm[..., 1]) / turn
        a, p, kappa = self.half_mm, 0.5 * (self.tension - 1j * self.shear), (3.0 - NU) / (1.0 + NU)

        def root(z: Float) -> Float:
            return np.sqrt(z - a) * np.sqrt(z + a)

        phi, slope, omega = p * (root(z) - z), p * (z / root(z) - 1.0), p * (root(np.conj(z)) - np.conj(z))
        crack = kappa * phi - omega - (z - np.conj(z)) * np.conj(slope)
        two_g = E_MPA / (1.0 + NU)
        strain = (self.along - NU * self.tension) / E_MPA, (self.tension - NU * self.along) / E_MPA
        x, y, tilt = z.real, z.imag, 0.5 * self.shear / (0.5 * two_g)
        uniform = strain[0] * x + tilt * y + 1j * (strain[1] * y + tilt * x)
        moved = (crack / two_g + uniform) * turn
        return np.stack([moved.real, moved.imag], axis=-1)


@dataclass(frozen=True)
class View:
    """Where a sheet is seen: grid of points every 7 px from (40, 60) px, 0.1 mm a pixel; subsets of 21 px."""

    rows: int = 46
    cols: int = 46
    tip_px: tuple[float, float] = (200.3, 218.4)

    def positions(self, sheet: Sheet, xy_px: Float) -> Float:
        """(..., 2) mm from the crack's middle; its right tip is at ``tip_px``."""
        tip = sheet.half_mm * np.array([np.cos(sheet.turn_rad), np.sin(sheet.turn_rad)])
        return np.asarray(MM_PER_PX * (xy_px - np.array(self.tip_px)) + tip)

    def crack_px(self, sheet: Sheet, ahead_mm: float = 0.0) -> Float:
        """(2, 2) the crack, its right tip last and drawn too far ahead by some mm."""
        along = np.array([np.cos(sheet.turn_rad), np.sin(sheet.turn_rad)]) / MM_PER_PX
        tip = np.array(self.tip_px)
        return np.array([tip - 2.0 * sheet.half_mm * along, tip + ahead_mm * along])


def seen(sheet: Sheet, view: View | None = None, *, sigma_mm: float = SIGMA_MM, common_mm: float = 0.0) -> Field:
    """A field without noise, with the covariance that it would have; the crack's drawing is in it."""
    view = View() if view is None else view
    field = make_field(lambda x: x, rows=view.rows, cols=view.cols, shape=_flat, growing=False)
    side = np.arange(SUBSET) - SUBSET // 2
    pixels = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    at = np.stack([field.x_px, field.y_px], axis=-1)[:, :, None] + pixels
    moved = sheet.displacement(view.positions(sheet, at)).mean(axis=2)
    uvw = np.concatenate([moved, np.zeros((*field.shape, 1))], axis=-1)
    own = np.broadcast_to(np.diag([1e-8, 1e-8, 4e-8, *sigma_mm**2 * np.array([1.0, 1.0, 9.0])]), (*field.shape, 6, 6))
    x, y = field.xyz_mm[..., 0], field.xyz_mm[..., 1]
    common = np.zeros((*field.shape, 6, 2))
    # a camera that turns and one whose scale is off, by what they do to a displacement: both smooth over the field
    common[..., 3, 0], common[..., 4, 0] = common_mm * x / 20.0, common_mm * y / 20.0
    common[..., 3, 1], common[..., 4, 1] = common_mm * (x / 20.0) ** 2, common_mm * x * y / 400.0
    return replace(
        field,
        uvw_mm=uvw,
        covariance=own.copy(),
        frozen=0.5 * own[..., 3:, 3:],
        common=common if common_mm else None,
        causes=Causes(("calibration", "calibration")) if common_mm else None,
        cuts=Cuts([view.crack_px(sheet)]),
    )


def _flat(x_px: Float, y_px: Float) -> Float:
    return np.stack([MM_PER_PX * x_px, MM_PER_PX * y_px, np.zeros_like(x_px)], axis=-1)


def drawn(field: Field, rng: np.random.Generator, copies: int) -> list[Field]:
    """Fields whose errors are drawn from what the field states of them."""
    assert field.uvw_mm is not None
    out = []
    for error in pixel_noise(rng, field, copies):
        shared = 0.0 if field.common is None else field.common @ rng.normal(size=field.common.shape[-1])
        whole = error + shared
        out.append(replace(field, xyz_mm=field.xyz_mm + whole[..., :3], uvw_mm=field.uvw_mm + whole[..., 3:]))
    return out
