"""Information in the views about the cameras, as normal equations to which further views can be added one at a time.

Each free pose is eliminated from its own views; the remaining equations for cameras, pitch and the target's corrections
add up from pose to pose. So the covariance after a further view needs no new adjustment. The covariance after a further
view is so had without a new adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.layout import Layout, Priors, State
from stereorig.core.calibration.fit.model import Linearised, linearise_all
from stereorig.core.calibration.fit.named import named_derivatives, parameter_names
from stereorig.core.calibration.fit.normal import Normal, assemble, inverse
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.calibration.guide.estimate import Estimate
from stereorig.core.calibration.uncertainty import point_derivatives
from stereorig.core.cameras.camera import RigidTransform

_MOST_POINTS = 100  # points of a target; a larger target is thinned to every other point


@dataclass(frozen=True, eq=False)
class Spread:
    """Standard deviations over the specimen's volume, the rigid motion common to all points taken out.

    Attributes
    ----------
    z_um
        Rms of Z.
    shape_um
        Rms of X, Y and Z.
    """

    z_um: float
    shape_um: float


@dataclass(frozen=True, eq=False)
class Information:
    """Normal equations of the unknowns that all poses share.

    Attributes
    ----------
    estimate
        The estimate at which they were built.
    points
        Indices of the target's points that represent all of them.
    matrix
        (s + n k, s + n k) of the shared unknowns that are free, then of the points' corrections.
    free
        (shared,) which of the unknowns before the steps and poses are free.
    q_z, q_shape
        (s, s): the trace of their product with the covariance is a mean variance over the volume, mm^2.
    """

    estimate: Estimate
    points: NDArray[np.intp]
    matrix: Float
    free: Bool
    q_z: Float
    q_shape: Float

    def spread(self, added: Float | None = None) -> Spread:
        """Return the uncertainty over the volume, with further information added.

        Raises
        ------
        CalibrationError
            ``calibration_singular``.
        """
        matrix = self.matrix if added is None else self.matrix + added
        s = int(self.free.sum())
        reduced = matrix[:s, :s]
        if len(matrix) > s:
            coupling = matrix[:s, s:]
            factor = cho_factor(matrix[s:, s:], lower=True, check_finite=False)
            reduced = reduced - coupling @ cho_solve(factor, coupling.T, check_finite=False)
        C = inverse(reduced)
        z, shape = (float(np.sqrt(max(np.sum(C * q), 0.0))) for q in (self.q_z, self.q_shape))
        return Spread(1e3 * z, 1e3 * shape)

    def of_poses(self, poses: Sequence[RigidTransform], seen_px: Sequence[tuple[Float, Float]]) -> list[Float]:
        """Return, for each further pose of the target, the matrix that both cameras' views would add to ``matrix``.

        Parameters
        ----------
        poses
            ``sys_from_target``.
        seen_px
            For each pose, (n, 2) image positions of all points in each camera, NaN for points not seen.
        """
        e, kept = self.estimate, self.points
        nominal = e.problem.flat_nodes_mm[kept]
        shared, k = len(self.free), e.priors.nodes_free
        first = e.problem.system_frame is None
        # all poses are linearised together; each has its own normal equations
        numbers = tuple(range(len(poses)))
        together = replace(e.layout, frames=() if first else numbers, steps=())
        x = np.zeros(together.size)
        x[:shared] = e.state.x[:shared]
        state = State(x, {} if first else dict(zip(numbers, poses, strict=True)), e.state.nodes_mm[kept])
        correlation = [float(np.mean([r.correlation for r in e.rows if r.camera == c] or [1.0])) for c in range(2)]
        rows = [
            _thought_of(c, number, xy[kept], correlation[c])
            for number, pair in zip(numbers, seen_px, strict=True)
            for c, xy in enumerate(pair)
        ]
        lins = [_as_only_pose(lin, shared) for lin in linearise_all(together, state, rows, nominal)]
        alone = replace(together, frames=() if first else numbers[:1])
        blank = Priors(
            np.zeros(alone.size),
            np.zeros(alone.size),
            np.ones(alone.size, dtype=bool),
            np.zeros(alone.size),
            np.where(np.arange(3) < k, 0.0, np.inf),
        )
        state = State(x[: alone.size], {}, state.nodes_mm)
        noise_px = _thinned(e.noise_px, e, kept)
        normals = (
            assemble(alone, state, rows[m : m + 2], nominal, blank, noise_px, lins=lins[m : m + 2])
            for m in range(0, len(rows), 2)
        )
        return [_without_poses(normal, shared, self.free) for normal in normals]


def _thought_of(camera: int, number: int, xy_px: Float, correlation: float) -> ViewRows:
    """Return the rows of a view that was not taken."""
    found = np.asarray(np.isfinite(xy_px).all(axis=-1))
    weight = np.asarray(found, dtype=np.float64)
    return ViewRows(camera, None, number, "", xy_px, found, weight, correlation=correlation)


def _as_only_pose(lin: Linearised, shared: int) -> Linearised:
    """Return the view with its pose's six unknowns right after the shared ones."""
    own = np.where(lin.columns < shared, lin.columns, shared + (lin.columns - shared) % 6)
    return replace(lin, columns=own)


def information(estimate: Estimate, volume_mm: Float) -> Information:
    """Return the information of the views taken.

    Parameters
    ----------
    estimate
        Cameras and poses.
    volume_mm
        (p, 3) points of the specimen's volume, system frame.
    """
    e = estimate
    n = len(e.problem.flat_nodes_mm)
    kept = np.arange(n) if n <= _MOST_POINTS else np.linspace(0, n - 1, _MOST_POINTS).round().astype(int)
    shared = e.layout.motion + 5
    free = e.priors.free[:shared]
    rows = [_part(row, kept) if len(kept) < n else row for row in e.rows]
    priors = replace(e.priors, node_weight=e.priors.node_weight * (n / len(kept)))
    state = replace(e.state, nodes_mm=e.state.nodes_mm[kept])
    normal = assemble(e.layout, state, rows, e.problem.flat_nodes_mm[kept], priors, _thinned(e.noise_px, e, kept))
    q_z, q_shape = _volume_forms(e, volume_mm, free)
    return Information(e, kept, _without_poses(normal, shared, free), free, q_z, q_shape)


def _thinned(noise_px: Float, e: Estimate, kept: NDArray[np.intp]) -> Float:
    """Noise with which some points contain as much information as all do."""
    return np.asarray(noise_px * np.sqrt(len(kept) / len(e.problem.flat_nodes_mm)))


def _part(row: ViewRows, kept: NDArray[np.intp]) -> ViewRows:
    # along lines the covariance would have to be thinned as well; as many independent points hold about the same
    # information
    return replace(row, xy_px=row.xy_px[kept], found=row.found[kept], weight=row.weight[kept], lines=None)


def _without_poses(normal: Normal, shared: int, free: Bool) -> Float:
    """Eliminate the poses; return the matrix of the free shared unknowns and the corrections."""
    U, W, k = normal.all_of_both, normal.coupling, normal.h.shape[1]
    here = np.flatnonzero(free)
    poses = np.flatnonzero(normal.free[shared:]) + shared
    flat = np.swapaxes(W, 0, 1).reshape(len(U), -1)  # (m, n k)
    if k == 0:
        M, coupling = U[np.ix_(here, here)], U[np.ix_(here, poses)]
    else:
        V = _dense(normal)
        M = np.block([[U[np.ix_(here, here)], flat[here]], [flat[here].T, V]])
        coupling = np.concatenate([U[np.ix_(here, poses)], flat[poses].T])
    if not len(poses):
        return np.asarray(M)
    # no view contains two poses, and the six unknowns of a pose are consecutive
    left = coupling.T.reshape(-1, 6, len(M))
    index = poses.reshape(-1, 6)
    blocks = U[index[:, :, None], index[:, None, :]]
    solved = np.linalg.solve(blocks, left).reshape(-1, len(M))
    return np.asarray(M - coupling @ solved)


def _dense(normal: Normal) -> Float:
    nodes = normal.nodes
    if nodes.together:
        return nodes.matrix
    n, k = len(nodes.matrix), nodes.k
    V = np.zeros((n, k, n, k))
    V[np.arange(n), :, np.arange(n), :] = nodes.matrix
    return V.reshape(n * k, n * k)


def _volume_forms(e: Estimate, volume_mm: Float, free: Bool) -> tuple[Float, Float]:
    layout: Layout = replace(e.layout, frames=(), steps=())
    x = e.state.x[: layout.size]
    names = parameter_names(layout, e.priors)
    rows = point_derivatives(e.pair, volume_mm, names) @ named_derivatives(layout, e.priors, x)
    flat = rows.reshape(-1, layout.size)[:, free]
    middle = volume_mm.mean(axis=0)
    rigid = np.zeros((len(volume_mm), 3, 6))
    rigid[:, range(3), range(3)] = 1.0
    for axis in range(3):
        rigid[:, :, 3 + axis] = np.cross(np.eye(3)[axis], volume_mm - middle)
    design = rigid.reshape(-1, 6)
    flat = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
    z = flat[2::3]
    return z.T @ z / len(z), flat.T @ flat / len(flat)
