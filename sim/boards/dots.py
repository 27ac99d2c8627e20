"""Textures of grids of round dots, in rows and columns or asymmetric; a dot's rim is a soft edge along its radius."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.sim.boards.pattern import (
    BEHIND,
    BOARD,
    FAR_MM,
    INK,
    PAPER,
    REACH_SD,
    ROOT_HALF,
    check_margin,
    plate_share,
    soft_step,
)
from stereorig.sim.texture import Texture


@dataclass(frozen=True, kw_only=True)
class DotsTexture(Texture):
    """Print of a grid of dots, in the flat form that the kernels take.

    Attributes
    ----------
    hollow
        (rows, columns) 1 where a dot is a ring.
    """

    hollow: NDArray[np.int64]

    def paint(self, s_mm: Float, t_mm: Float, out: Float) -> None:
        """Write the brightness of material points into ``out`` (n,); NaN points leave their element as it is."""
        _dots(self.parameters, self.nodes_mm, self.hollow, s_mm, t_mm, out)


def dots_board(
    *,
    pitch_mm: float,
    errors_mm: Float,
    margin_mm: float,
    dot_mm: float,
    asymmetric: bool,
    marks: bool = False,
    edge_mm: float | None = None,
) -> DotsTexture:
    """Return a grid of round dots.

    Parameters
    ----------
    pitch_mm, errors_mm, margin_mm
        As in :func:`stereorig.sim.boards.squares.squares_board`; ``errors_mm`` moves whole dots, the margin is about
        the outermost dots.
    dot_mm
        Diameter of a dot.
    asymmetric
        Rows are a pitch apart, dots of one row two pitches, odd rows are shifted by one.
    marks
        Three dots are rings of half the inner diameter: three corners of a rectangle about the centre, which show the
        board's rotation.
    edge_mm
        Softness of the edges (sd of the Gaussian); a 150th of the pitch by default.
    """
    rows, columns = errors_mm.shape[:2]
    edge = pitch_mm / 150.0 if edge_mm is None else edge_mm
    radius, worst = 0.5 * dot_mm, float(np.abs(errors_mm).max())
    room = pitch_mm * (ROOT_HALF if asymmetric else 0.5)
    if not (edge > 0.0 and radius > 2.0 * REACH_SD * edge and radius + REACH_SD * edge + worst < room):
        raise ValueError(f"dots of {dot_mm:g} mm with edges of {edge:g} mm do not fit a pitch of {pitch_mm:g} mm")
    check_margin(margin_mm)
    wide = 2 * columns - 1 if asymmetric else columns - 1
    half = (0.5 * wide * pitch_mm + radius + margin_mm, 0.5 * (rows - 1) * pitch_mm + radius + margin_mm)
    hollow = np.zeros((rows, columns), dtype=np.int64)
    if marks:
        i, j = max(columns // 4, 1 if columns > 3 else 0), max(rows // 4, 1 if rows > 3 else 0)
        hollow[[j, j, rows - 1 - j], [i, columns - 1 - i, i]] = 1
    par = np.array([pitch_mm, edge, INK, PAPER, BEHIND, *half, radius, worst, 1.0 if asymmetric else 0.0])
    return DotsTexture(
        kind=BOARD, parameters=par, nodes_mm=np.ascontiguousarray(errors_mm), finest_mm=edge, hollow=hollow
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _dots(par: Float, errors: Float, hollow: NDArray[np.int64], s: Float, t: Float, out: Float) -> None:
    pitch, per_mm, root = par[0], 1.0 / par[0], ROOT_HALF / par[1]
    ink, paper, behind, radius = par[2], par[3], par[4], par[7]
    n_j, n_i = hollow.shape
    asymmetric = par[9] > 0.0
    centre_b = 0.5 * (n_j - 1)
    centre_a = 0.5 * (2.0 * n_i - 1.0) if asymmetric else 0.5 * (n_i - 1)
    outer = radius + REACH_SD * par[1] + 2.0 * par[8]
    for k in range(s.size):
        sk, tk = s[k], t[k]
        if not (abs(sk) < FAR_MM and abs(tk) < FAR_MM):
            continue
        plate = plate_share(par, sk, tk)
        if plate == 0.0:
            out[k] = behind
            continue
        a, b = sk * per_mm + centre_a, tk * per_mm + centre_b
        cover = 0.0
        # an asymmetric grid's nearest dot may be in either of the two rows about the point
        first = int(np.floor(b)) if asymmetric else int(np.floor(b + 0.5))
        for j in range(first, first + (2 if asymmetric else 1)):
            shift = float(j % 2) if asymmetric else 0.0
            i = int(np.floor(0.5 * (a - shift) + 0.5)) if asymmetric else int(np.floor(a + 0.5))
            if not (0 <= j < n_j and 0 <= i < n_i):
                continue
            x = (2.0 * i + shift if asymmetric else float(i)) - centre_a
            dx, dy = sk - pitch * x - errors[j, i, 0], tk - pitch * (j - centre_b) - errors[j, i, 1]
            r2 = dx * dx + dy * dy
            if r2 < outer * outer:
                r = np.sqrt(r2)
                cover += soft_step(radius - r, root)
                if hollow[j, i] == 1:
                    cover -= soft_step(0.5 * radius - r, root)
        v = paper + (ink - paper) * cover
        out[k] = behind + (v - behind) * plate
