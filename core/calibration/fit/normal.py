"""Normal equations of the adjustment, with the nodes' corrections eliminated.

If a view's positions are independent of each other, a node's corrections occur only in its own observations and are
eliminated node by node (Schur complement). Intersections of a line grid are found from pieces of line that neighbours
share; their precision couples nodes along a line, and the nodes are then eliminated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.layout import Layout, Priors, State
from stereorig.core.calibration.fit.model import Linearised, linearise_all
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.errors import CalibrationError


@dataclass(frozen=True)
class Extra:
    """Further unknowns, held at zero, which the residuals are tested for after the fit.

    Attributes
    ----------
    columns
        (q,) their places after the layout's own.
    values
        (n, 2, q) derivatives of the image.
    """

    columns: NDArray[np.intp]
    values: Float


@dataclass(frozen=True)
class NodeBlock:
    """The nodes' own part of the normal equations: blocks (n, k, k), or all together (n k, n k)."""

    matrix: Float
    k: int

    @property
    def together(self) -> bool:
        """Return True if nodes are coupled with each other."""
        return self.matrix.ndim == 2

    def damped(self, damping: float) -> NodeBlock:
        """Return the block with its diagonal increased."""
        matrix = self.matrix.copy()
        if self.together:
            matrix[np.diag_indices(len(matrix))] *= 1.0 + damping
        else:
            matrix[:, range(self.k), range(self.k)] *= 1.0 + damping
        return NodeBlock(matrix, self.k)

    @cached_property
    def _factor(self) -> tuple[Float, bool]:
        from scipy.linalg import cho_factor  # slow to load, and not every start needs it

        factor, lower = cho_factor(self.matrix)
        return np.asarray(factor), bool(lower)

    def solve(self, right: Float) -> Float:
        """Return the inverse times (n, k, p)."""
        from scipy.linalg import cho_solve  # slow to load, and not every start needs it

        if not self.together:
            return np.asarray(np.linalg.solve(self.matrix, right))
        n, k, p = right.shape
        return np.asarray(cho_solve(self._factor, right.reshape(n * k, p))).reshape(n, k, p)

    def times(self, values: Float) -> Float:
        """Return the block times (n, k, p)."""
        if not self.together:
            return np.asarray(self.matrix @ values)
        n, k, p = values.shape
        return (self.matrix @ values.reshape(n * k, p)).reshape(n, k, p)


@dataclass(frozen=True)
class Normal:
    """Normal equations in blocks: unknowns, their coupling to the nodes, nodes.

    Attributes
    ----------
    U
        (2, m, m) from each camera's observations, without priors.
    g
        (m,) right-hand side, with priors.
    W
        (2, n, m, k) coupling, of each camera.
    V
        Nodes' block of each camera, without priors.
    h
        (n, k) right-hand side of the nodes, with priors.
    prior
        (m,) weights of the priors.
    node_prior
        (k,) weights of the nodes' priors.
    free
        (m,) True for unknowns that are not held.
    cost
        Weighted squares of residuals and priors.
    squares
        (2,) weighted squares of the residuals, px^2, of each camera.
    valid
        True if every observed point has an image.
    """

    U: Float
    g: Float
    W: Float
    V: tuple[NodeBlock, NodeBlock]
    h: Float
    prior: Float
    node_prior: Float
    free: Bool
    cost: float
    squares: Float
    valid: bool

    @cached_property
    def nodes(self) -> NodeBlock:
        """The nodes' block of both cameras, with priors."""
        matrix = self.V[0].matrix + self.V[1].matrix
        k = self.V[0].k
        if self.V[0].together:
            matrix[np.diag_indices(len(matrix))] += np.tile(self.node_prior, len(matrix) // k)
        else:
            matrix[:, range(k), range(k)] += self.node_prior
        return NodeBlock(matrix, k)

    @property
    def all_of_both(self) -> Float:
        """(m, m) of both cameras' observations and the priors."""
        return np.asarray(self.U.sum(axis=0) + np.diag(self.prior))

    @property
    def coupling(self) -> Float:
        """(n, m, k) of both cameras."""
        return np.asarray(self.W.sum(axis=0))

    def reduced(self, damping: float = 0.0) -> tuple[Float, Float, Float | None]:
        """Return the (m, m) matrix and (m,) right-hand side without the nodes, and V^-1 W' (n, k, m)."""
        U, g = self.all_of_both, self.g.copy()
        U[np.diag_indices(len(U))] *= 1.0 + damping
        if not self.h.shape[1]:
            return U, g, None
        W = self.coupling
        Y = self.nodes.damped(damping).solve(np.swapaxes(W, 1, 2))
        m = len(g)
        flat = np.swapaxes(W, 1, 2).reshape(-1, m)
        U -= flat.T @ Y.reshape(-1, m)
        g -= Y.reshape(-1, m).T @ self.h.ravel()
        return U, g, Y

    def step(self, damping: float) -> tuple[Float, Float]:
        """Return the Levenberg-Marquardt step of the unknowns (m,) and of the nodes (n, k)."""
        U, g, Y = self.reduced(damping)
        free = self.free
        step = np.zeros(len(g))
        step[free] = inverse(U[np.ix_(free, free)]) @ g[free]
        if Y is None:
            return step, np.zeros_like(self.h)
        nodes = self.nodes.damped(damping).solve(self.h[..., None])[..., 0] - Y @ step
        return step, nodes


@dataclass(frozen=True)
class Covariance:
    """Covariance at the minimum.

    Attributes
    ----------
    unknowns
        (m, m), zero for held unknowns.
    node_sigma_mm
        (n, k).
    taken
        (2,) number of observations that the fit uses up, for each camera.
    """

    unknowns: Float
    node_sigma_mm: Float
    taken: Float


def assemble(
    layout: Layout,
    state: State,
    views: Sequence[ViewRows],
    nominal_nodes_mm: Float,
    priors: Priors,
    noise_px: Float,
    *,
    extras: Sequence[Extra] | None = None,
    n_extra: int = 0,
    lins: Sequence[Linearised] | None = None,
) -> Normal:
    """Build the normal equations of all views at a state; ``extras`` are held unknowns after the layout's own.

    ``lins`` are the views' derivatives if they are known already.
    """
    n, k, m = len(nominal_nodes_mm), priors.nodes_free, layout.size + n_extra
    if lins is None:
        lins = linearise_all(layout, state, views, nominal_nodes_mm)
    together = k > 0 and any(view.lines is not None for view in views)
    U, g = np.zeros((2, m, m)), np.zeros(m)
    W, h = np.zeros((2, n, m, k)), np.zeros((n, k))
    V = [np.zeros((n * k, n * k) if together else (n, k, k)) for _ in range(2)]
    squares, cost = np.zeros(2), 0.0
    for index, (view, lin) in enumerate(zip(views, lins, strict=True)):
        c = view.camera
        factor = 1.0 / (float(noise_px[c]) ** 2 * view.correlation)
        extra = None if extras is None else extras[index]
        energy = _add(view, lin, extra, factor, U[c], g, W[c], V[c], h, k)
        squares[c] += energy
        cost += energy * factor
    p = np.zeros(m)
    p[: layout.size] = priors.weight
    off = priors.mean - state.x
    g[: layout.size] += priors.weight * off
    cost += float(np.sum(priors.weight * off**2))
    node_prior = priors.node_weight[:k]
    if k:
        d = state.nodes_mm[:, :k]
        h -= node_prior * d
        cost += float(np.sum(node_prior * d**2))
    free = np.zeros(m, dtype=bool)
    free[: layout.size] = priors.free
    blocks = NodeBlock(V[0], k), NodeBlock(V[1], k)
    return Normal(U, g, W, blocks, h, p, node_prior, free, cost, squares, all(lin.valid for lin in lins))


def _add(
    view: ViewRows,
    lin: Linearised,
    extra: Extra | None,
    factor: float,
    U: Float,
    g: Float,
    W: Float,
    V: Float,
    h: Float,
    k: int,
) -> float:
    """Add one view; return the weighted squares of its residuals, px^2."""
    A, columns, r = lin.by_unknown, lin.columns, lin.residual_px
    if extra is not None:
        A, columns = np.concatenate([A, extra.values], axis=-1), np.concatenate([columns, extra.columns])
    B = lin.by_node[..., :k]
    p = A.shape[-1]
    lines = view.lines
    if lines is not None:
        A, B, r = lines.project(A), lines.project(B), lines.project(r)
        weighted = lines.weigh(np.concatenate([A, r[..., None]], axis=-1))
        WA, Wr = factor * weighted[..., :p], factor * weighted[..., p]
    else:
        weight = factor * view.weight[:, None]
        WA, Wr = weight[..., None] * A, weight * r
    flat, weighted_flat = A.reshape(-1, p), WA.reshape(-1, p)
    U[np.ix_(columns, columns)] += weighted_flat.T @ flat
    g[columns] += weighted_flat.T @ r.ravel()
    if k:
        W[:, columns] += np.swapaxes(WA, 1, 2) @ B
        h += np.einsum("ni,nij->nj", Wr, B)
        if lines is not None:
            _add_lines(V, lines.precision_a * factor, B[:, 0], lines.shape, k, across=False)
            _add_lines(V, lines.precision_b * factor, B[:, 1], lines.shape, k, across=True)
        elif V.ndim == 2:
            block = np.swapaxes(B, 1, 2) @ (factor * view.weight[:, None, None] * B)
            at = np.arange(len(B))[:, None] * k + np.arange(k)
            V[at[:, :, None], at[:, None, :]] += block
        else:
            V += np.swapaxes(B, 1, 2) @ (factor * view.weight[:, None, None] * B)
    return float(np.sum(Wr * r) / factor)


def _add_lines(V: Float, precision: Float, rows: Float, shape: tuple[int, int], k: int, *, across: bool) -> None:
    """Add the coupling of the nodes along the lines of one family; ``rows`` (n, k) are d(offset)/d(node)."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    for line, P in zip(index.T if across else index, precision, strict=True):
        G = rows[line]  # (m, k)
        block = np.einsum("ab,ai,bj->aibj", P, G, G).reshape(len(line) * k, len(line) * k)
        at = (line[:, None] * k + np.arange(k)).ravel()
        V[np.ix_(at, at)] += block


def inverse(matrix: Float) -> Float:
    """Invert a symmetric positive definite matrix after scaling its diagonal to one.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular``.
    """
    diagonal = np.diagonal(matrix)
    if not np.isfinite(matrix).all() or (diagonal <= 0.0).any():
        raise CalibrationError("The normal equations hold no finite positive diagonal.", code="calibration_singular")
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
    if values[0] <= 1e-14 * values[-1]:
        raise CalibrationError(
            f"The views do not determine the cameras: the normal equations' eigenvalues go from {values[0]:.1e} to "
            f"{values[-1]:.1e}.",
            code="calibration_singular",
            remedy="Take views at stage positions that lie further apart, or of a board that is tilted more.",
        )
    half = (vectors / np.sqrt(values)) * scale[:, None]
    return np.asarray(half @ half.T)


def covariance(normal: Normal) -> Covariance:
    """Return the covariance of the unknowns and nodes, and the observations that the fit took up."""
    S, _, Y = normal.reduced()
    free = normal.free
    m, (n, k) = len(S), normal.h.shape
    C = np.zeros((m, m))
    C[np.ix_(free, free)] = inverse(S[np.ix_(free, free)])
    taken = np.array([float(np.sum(C * normal.U[c])) for c in range(2)])
    if Y is None:
        return Covariance(C, np.zeros((n, 0)), taken)
    CY = C @ np.swapaxes(Y, 1, 2)  # minus the covariance of unknowns and nodes, (n, m, k)
    for c in range(2):
        taken[c] -= 2.0 * float(np.sum(CY * normal.W[c]))
    if normal.nodes.together:
        flat = Y.reshape(n * k, m)
        C_nn = normal.nodes.solve(np.eye(n * k).reshape(n, k, n * k)).reshape(n * k, n * k) + flat @ C @ flat.T
        node_sigma = np.sqrt(np.diagonal(C_nn)).reshape(n, k)
        for c in range(2):
            taken[c] += float(np.sum(C_nn * normal.V[c].matrix))
    else:
        C_nn = np.linalg.inv(normal.nodes.matrix) + Y @ CY
        node_sigma = np.sqrt(np.diagonal(C_nn, axis1=1, axis2=2))
        for c in range(2):
            taken[c] += float(np.sum(C_nn * normal.V[c].matrix))
    return Covariance(C, node_sigma, taken)


def prior_part(normal: Normal, found: Covariance, unknowns: Sequence[int], *, nodes: bool = False) -> Float:
    """Return the part (m, m) of the unknowns' covariance that priors put there, of some unknowns and of the nodes.

    The estimate's errors are N^-1 times the error of each observation, a prior being one of them; so its part of the
    covariance is its term of N^-1 (A' W A + sum of priors) N^-1 = N^-1.

    Parameters
    ----------
    normal
        At the minimum.
    found
        Its covariance.
    unknowns
        Places of the unknowns whose priors count.
    nodes
        Count the nodes' priors, too.
    """
    C, index = found.unknowns, list(unknowns)
    out = (C[:, index] * normal.prior[index]) @ C[index]
    if nodes and normal.h.shape[1]:
        Y = normal.reduced()[2]
        assert Y is not None
        CY = C @ np.swapaxes(Y, 1, 2)
        out = out + np.einsum("nik,k,njk->ij", CY, normal.node_prior, CY, optimize=True)
    return np.asarray(0.5 * (out + out.T))
