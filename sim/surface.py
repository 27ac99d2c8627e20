"""Analytic surfaces and their deformation: from material point (s, t) to the body's frame, and back from a ray.

The body's frame has z pointing away from the cameras, like the system frame; a scene's pose puts the body into the
system frame. (s, t) are material coordinates in mm: they identify a material point in all states, and the texture is
defined in them.

All formulas are closed. The kernels take flat numbers and whole arrays; they come from `stereorig.sim.plate`,
`stereorig.sim.panel`, `stereorig.sim.notch` and `stereorig.sim.steel`. For a ray (nx, ny, 1) in the camera's frame the
material point that it meets solves

    X_cam(s, t) - nx Z_cam(s, t) = 0,  Y_cam(s, t) - ny Z_cam(s, t) = 0

by Newton's method with the surface's own tangents, from the ray's intersection with the body's plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.sim import formulas as kernels

FLAT: Final = 0
HEIGHT: Final = 1
PLATE: Final = 2
PANEL: Final = 3
SPHERE: Final = 4
BOWL: Final = 5
NOTCH: Final = 6
_NO_TABLE: Final = np.zeros((4, 4))
_STEPS: Final = 30
# a Newton step shorter than this leaves an error of half the curvature times its square: 1e-10 mm at 0.02 per mm
_STEP_MM: Final = 1e-4
_CHUNK: Final = 4096  # rays solved together: their tangents stay in the cache


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A surface in one state of deformation, in the flat form that the kernels take.

    Attributes
    ----------
    kind
        ``FLAT``, ``HEIGHT``, ``PLATE``, ``PANEL``, ``SPHERE``, ``BOWL`` or ``NOTCH``.
    parameters
        Numbers of that kind, see `stereorig.sim.formulas`.
    coarse, fine
        Coefficient tables of a height field.
    """

    kind: int
    parameters: Float
    coarse: Float = field(default_factory=_NO_TABLE.copy)
    fine: Float = field(default_factory=_NO_TABLE.copy)

    def positions(self, st_mm: ArrayLike, lip: ArrayLike = 1.0) -> Float:
        """Return body positions (..., 3) of material points (..., 2); ``lip`` +-1 picks a crack's lip."""
        return self._evaluated(st_mm, lip)[..., :3]

    def tangents(self, st_mm: ArrayLike, lip: ArrayLike = 1.0) -> Float:
        """Return d(position) / d(s, t), (..., 3, 2), at material points (..., 2)."""
        values = self._evaluated(st_mm, lip)
        return np.stack([values[..., 3:6], values[..., 6:9]], axis=-1)

    def hit(self, pose: Float, nx: Float, ny: Float) -> tuple[Float, Float, Float]:
        """Return material coordinates s, t and lip (n,) at the rays (nx, ny, 1); NaN for rays that meet nothing.

        Parameters
        ----------
        pose
            (3, 4) cam_from_body.
        nx, ny
            (n,) directions.
        """
        s, t = np.empty_like(nx), np.empty_like(nx)
        if self.kind == FLAT:
            kernels.meet_plane(self.parameters, pose, nx, ny, s, t)
            return s, t, np.broadcast_to(np.float64(1.0), nx.shape)
        if self.kind == BOWL:
            kernels.meet_bowl(self.parameters, pose, nx, ny, s, t)
            return s, t, np.broadcast_to(np.float64(1.0), nx.shape)
        lip = np.ones_like(nx)
        for a in range(0, nx.size, _CHUNK):
            part = slice(a, a + _CHUNK)
            self._hit_curved(pose, nx[part], ny[part], s[part], t[part], lip[part])
        return s, t, lip

    def _hit_curved(self, pose: Float, nx: Float, ny: Float, s: Float, t: Float, lip: Float) -> None:
        kernels.meet_plane(np.array([1.0, 0.0, 0.0, 1.0]), pose, nx, ny, s, t)
        if self.kind != PANEL:
            self._newton(pose, nx, ny, s, t, lip)
            if self.kind == NOTCH:
                cut = kernels.inside_notch(self.parameters, s, t)
                s[cut] = t[cut] = np.nan
            return
        # a crack: first the lip on whose side the ray seems to be, then the other; between the lips there is nothing
        half_crack = self.parameters[0]
        lip[:] = np.where(t >= 0.0, 1.0, -1.0)
        start = s.copy(), t.copy()
        self._newton(pose, nx, ny, s, t, lip)
        wrong = np.flatnonzero(~((np.abs(s) >= half_crack) | (t * lip >= 0.0)))
        if wrong.size:
            other_s, other_t, other = start[0][wrong], start[1][wrong], -lip[wrong]
            self._newton(pose, nx[wrong], ny[wrong], other_s, other_t, other)
            right = (np.abs(other_s) >= half_crack) | (other_t * other >= 0.0)
            s[wrong] = np.where(right, other_s, np.nan)
            t[wrong] = np.where(right, other_t, np.nan)
            lip[wrong] = np.where(right, other, lip[wrong])
        beyond = np.abs(s) >= half_crack
        lip[beyond] = np.where(t[beyond] >= 0.0, 1.0, -1.0)

    def _newton(self, pose: Float, nx: Float, ny: Float, s: Float, t: Float, lip: Float) -> None:
        """Move (s, t) to the rays' intersections with the surface; NaN if that does not converge."""
        values = np.empty((9, nx.size))
        step = np.empty(nx.size)
        for _ in range(_STEPS):
            self._evaluate(s, t, lip, values)
            if kernels.newton_step(pose, nx, ny, values, s, t, step) < _STEP_MM:
                break
        else:
            s[~(step < _STEP_MM)] = np.nan
            t[~(step < _STEP_MM)] = np.nan

    def _evaluated(self, st_mm: ArrayLike, lip: ArrayLike) -> Float:
        st = np.asarray(st_mm, dtype=np.float64)
        side = np.ascontiguousarray(np.broadcast_to(np.asarray(lip, dtype=np.float64), st.shape[:-1])).reshape(-1)
        flat = st.reshape(-1, 2)
        values = np.empty((9, side.size))
        self._evaluate(np.ascontiguousarray(flat[:, 0]), np.ascontiguousarray(flat[:, 1]), side, values)
        return values.T.reshape(*st.shape[:-1], 9)

    def _evaluate(self, s: Float, t: Float, lip: Float, values: Float) -> None:
        if self.kind == HEIGHT:
            kernels.height_field(self.parameters, self.coarse, self.fine, s, t, values)
        elif self.kind == PANEL:
            kernels.cracked_panel(self.parameters, s, t, lip, values)
        else:
            _SMOOTH[self.kind](self.parameters, s, t, values)


_SMOOTH: Final[dict[int, Callable[[Float, Float, Float, Float], None]]] = {
    FLAT: kernels.plane,
    PLATE: kernels.circular_plate,
    SPHERE: kernels.sphere,
    BOWL: kernels.bowl,
    NOTCH: kernels.notched_sheet,
}


def flat(in_plane: ArrayLike = ((1.0, 0.0), (0.0, 1.0))) -> Surface:
    """Return a plane, z = 0, whose material points are at ``in_plane @ (s, t)``."""
    return Surface(kind=FLAT, parameters=np.asarray(in_plane, dtype=np.float64).reshape(4).copy())


def sphere(radius_mm: float) -> Surface:
    """Return a sphere whose pole touches z = 0 and bulges towards the cameras; (s, t) are arc lengths from the pole."""
    return Surface(kind=SPHERE, parameters=np.array([radius_mm]))


def bowl(rise_mm: float, half_mm: float) -> Surface:
    """Return a slightly bent plate, z = ``rise_mm`` (x^2 + y^2) / ``half_mm``^2, with (s, t) = (x, y).

    A plate bends without stretching; that its points draw together by ``rise_mm``^2 / ``half_mm`` is left out.
    """
    if not (half_mm > 0.0 and abs(rise_mm) < half_mm):
        raise ValueError(f"a rise of {rise_mm:g} mm over {half_mm:g} mm is no slightly bent plate")
    return Surface(kind=BOWL, parameters=np.array([rise_mm / half_mm**2]))
