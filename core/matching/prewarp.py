"""Images warped once along a prediction: the narrow functions before the compiled kernels.

The prediction is a lattice of nodes with the unknowns of a patch there and their slopes. The exact cameras turn them
into positions in the compared images, and bicubic polynomials between the nodes into a place for every pixel of camera
1's reference.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.matching.arguments import flat, lens_of, own
from stereorig.core.matching.image import ImageData
from stereorig.core.matching.kernels.drivers import kernel_sources
from stereorig.core.matching.kernels.lattice import interpolate_cubic, interpolate_quintic, places
from stereorig.core.matching.kernels.naming import entry, entry_with_arrays, stamp_of
from stereorig.core.matching.kernels.point import epipolar_shift
from stereorig.core.matching.kernels.vectors import LANES
from stereorig.core.matching.kernels.warp import image_of, lens_jacobian
from stereorig.core.threads import run_ranges

_ROWS_AT_ONCE = 32
_IMAGES = 3


class NodeLattice(NamedTuple):
    """Column and row of the first point, px; distance of points; nodes beyond the points on each side."""

    x0: float
    y0: float
    spacing: float
    rim: int


def warp_image(
    image: ImageData, shape: tuple[int, int], lattice: NodeLattice, nodes: Float, seen: Bool
) -> tuple[Float32, NDArray[np.uint8]]:
    """Interpolate a compared image at the predicted place of each pixel of camera 1's reference.

    Parameters
    ----------
    image
        The image.
    shape
        Rows and columns of camera 1's reference.
    lattice, nodes, seen
        (r, c, 2, 4) the image's positions of :func:`project_nodes`; (r - 1, c - 1) True between four nodes with a
        prediction.

    Returns
    -------
    values
        As in :class:`stereorig.core.matching.arguments.WarpedImages`; any number where there is no prediction.
    inside
        (rows, cols) 1 where there is one, and the image shows the place.
    """
    rows, cols = shape
    width = -(-cols // LANES) * LANES
    values, inside = np.empty((rows, width), np.float32), np.zeros((rows, cols), np.uint8)
    first = max(int(np.ceil(lattice.y0 - lattice.rim * lattice.spacing)), 0)
    last = min(int(np.floor(lattice.y0 + (len(nodes) - 1 - lattice.rim) * lattice.spacing)) + 1, rows)
    given = flat(image), lattice, own(nodes), seen.astype(np.uint8), image.order
    local = threading.local()

    def work(begin: int, end: int) -> None:
        if not hasattr(local, "space"):
            tx, ty = (np.zeros(width, np.float32) for _ in range(2))
            lines, tap = np.zeros((4, nodes.shape[1])), np.zeros(width, np.int32)
            local.space = lines, tap, tx, ty, np.zeros((1, width), np.float32)
        _warp_rows(begin + first, end + first, *given, local.space, values, inside)

    if last > first:
        run_ranges(work, last - first, _ROWS_AT_ONCE)
    return values, inside


def project_nodes(pair: StereoPair, rays: Float, state: Float, lattice: NodeLattice) -> tuple[Float, Float]:
    """Return the images' positions at the nodes, and the unknowns of the patches there.

    Parameters
    ----------
    pair
        The cameras.
    rays
        (r, c, 2) x and y of camera 1's normalised rays through the nodes.
    state
        (r, c, 5, 4): inverse depth, current position over depth less the ray, epipolar offset, each with its slopes
        along columns and rows and the mixed derivative, a spacing.
    lattice
        The nodes.

    Returns
    -------
    positions
        (r, c, 6, 4) px of x and y in camera 2's reference, camera 1's and camera 2's current image, with the same
        derivatives; NaN where a camera does not see a node.
    unknowns
        (r, c, 4, 3): the rows w, G_0, G_1, G_2 of a plane patch, as the matching has them.
    """
    r, c = rays.shape[:2]
    positions, unknowns = np.full((r, c, 2 * _IMAGES, 4), np.nan), np.full((r, c, 4, 3), np.nan)
    pose = pair.cam2_from_cam1
    cameras = lens_of(pair.cam1), lens_of(pair.cam2), own(pose.rotation), own(pose.translation_mm)
    given = own(rays), own(state), lattice.spacing
    run_ranges(lambda first, last: _project(first, last, *cameras, *given, positions, unknowns), r, _ROWS_AT_ONCE)
    return positions, unknowns


def _entries(stamp: int):  # type: ignore[no-untyped-def]
    @entry
    def warp_rows(first, last, image, lattice, nodes, seen, order, space, values, inside):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        lines, tap, tx, ty, row = space
        cols, blocks = inside.shape[1], np.int64(tap.shape[0] // LANES)
        coefficients, stride = image.coefficients, np.int64(image.stride)
        for y in range(first, last):
            top = int(np.floor((y - lattice.y0) / lattice.spacing + lattice.rim))
            if top < 0 or top >= seen.shape[0]:
                continue
            for x in range(cols):
                row[0, x] = 1.0
            places(y, lattice, nodes, seen, image, (0, cols), 1 if order == 3 else 2, lines, row, tap, tx, ty)
            if order == 3:
                interpolate_cubic(coefficients, stride, tap, tx, ty, blocks, values[y])
            else:
                interpolate_quintic(coefficients, stride, tap, tx, ty, blocks, values[y])
            for x in range(cols):
                inside[y, x] = 1 if row[0, x] == 1.0 else 0

    @entry_with_arrays
    def project(first, last, lens1, lens2, R, t, rays, state, spacing, positions, unknowns):
        if stamp < 0:
            return
        q, s = np.zeros((3, 4)), np.zeros((3, 4))
        for r in range(first, last):
            for c in range(rays.shape[1]):
                xc, yc, of = rays[r, c, 0], rays[r, c, 1], state[r, c]
                if not (np.isfinite(xc + yc) and of[0, 0] > 0.0 and of[3, 0] > -1.0):
                    continue
                j11, j12, j21, j22 = lens_jacobian(lens1, xc, yc)
                nu_x, nu_y, _ = epipolar_shift(lens2, R, t, xc, yc, of[0, 0])
                # slopes over the ray from slopes over the image
                for i in range(4):
                    a, b = of[i, 1] / spacing, of[i, 2] / spacing
                    unknowns[r, c, i, 0] = of[i, 0] + (xc if i == 1 else yc if i == 2 else 1.0 if i == 3 else 0.0)
                    unknowns[r, c, i, 1] = a * j11 + b * j21 + (1.0 if i == 1 else 0.0)
                    unknowns[r, c, i, 2] = a * j12 + b * j22 + (1.0 if i == 2 else 0.0)
                over = spacing / (j11 * j22 - j12 * j21)
                for d in range(4):
                    s[0, d] = s[1, d] = s[2, d] = 0.0
                s[0, 0], s[0, 1], s[0, 2] = xc, over * j22, -over * j12
                s[1, 0], s[1, 1], s[1, 2] = yc, -over * j21, over * j11
                s[2, 0] = 1.0
                for k in range(_IMAGES):
                    for d in range(4):
                        moved = 0.0 if k == 0 else 1.0
                        g0, g1, g2 = s[0, d] + moved * of[1, d], s[1, d] + moved * of[2, d], s[2, d] + moved * of[3, d]
                        for i in range(3):
                            if k == 1:
                                q[i, d] = s[i, d] + of[1 + i, d]
                            else:
                                q[i, d] = R[i, 0] * g0 + R[i, 1] * g1 + R[i, 2] * g2 + t[i] * of[0, d]
                    z = q[2, 0]
                    lens = lens1 if k == 1 else lens2
                    u, v = q[0, 0] / z, q[1, 0] / z
                    ux, uy = (q[0, 1] - u * q[2, 1]) / z, (q[0, 2] - u * q[2, 2]) / z
                    vx, vy = (q[1, 1] - v * q[2, 1]) / z, (q[1, 2] - v * q[2, 2]) / z
                    uxy = (q[0, 3] - u * q[2, 3] - ux * q[2, 2] - uy * q[2, 1]) / z
                    vxy = (q[1, 3] - v * q[2, 3] - vx * q[2, 2] - vy * q[2, 1]) / z
                    if k != 1:
                        u, v = u + of[4, 0] * nu_x, v + of[4, 0] * nu_y
                        ux, uy, uxy = ux + of[4, 1] * nu_x, uy + of[4, 2] * nu_x, uxy + of[4, 3] * nu_x
                        vx, vy, vxy = vx + of[4, 1] * nu_y, vy + of[4, 2] * nu_y, vxy + of[4, 3] * nu_y
                    if not (z > 0.0 and u * u + v * v < lens[11]):
                        continue
                    x, y, a11, a12, a21, a22 = image_of(lens, u, v)
                    at_x, at_y = positions[r, c, 2 * k], positions[r, c, 2 * k + 1]
                    at_x[0], at_x[1], at_x[2] = x, a11 * ux + a12 * vx, a11 * uy + a12 * vy
                    at_y[0], at_y[1], at_y[2] = y, a21 * ux + a22 * vx, a21 * uy + a22 * vy
                    at_x[3], at_y[3] = a11 * uxy + a12 * vxy, a21 * uxy + a22 * vxy

    return warp_rows, project


_warp_rows, _project = _entries(stamp_of(kernel_sources()))
