"""How the target's true nodes may depart from the nominal grid: the unknowns of the adjustment besides the cameras.

A localiser that takes each intersection from its own neighbourhood shows every node's error; one that fits whole
lines shows what is left of the errors along the line: offset and slope of a straight line, and the curvature of a
parabola. The unknowns must be of the kind that the localiser lets through. Per line they are coefficients of
orthonormal polynomials over the line's nodes, so that independent errors of the nodes with one standard deviation
give independent coefficients with the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.lens import Float


@dataclass(frozen=True)
class CorrectionBasis:
    """``corrections of node n = matrix[n] @ coefficients`` in independent blocks of coefficients.

    Attributes
    ----------
    matrix
        (n, 2, k) where all coefficients make one block; None where each node has its own two.
    """

    matrix: Float | None

    def corrections(self, coefficients: Float) -> Float:
        """Return the nodes' corrections (n, 2) from coefficients (blocks, k)."""
        return coefficients if self.matrix is None else np.asarray(self.matrix @ coefficients[0])

    def zero(self, n: int) -> Float:
        """Return coefficients of no correction, (blocks, k)."""
        return np.zeros((n, 2)) if self.matrix is None else np.zeros((1, self.matrix.shape[2]))

    def vectors(self, h: Float) -> Float:
        """Gather node vectors (n, 2) into (blocks, k)."""
        return h if self.matrix is None else np.einsum("nik,ni->k", self.matrix, h, optimize=True)[None]

    def couplings(self, W: Float) -> Float:
        """Gather couplings with p parameters (n, p, 2) into (blocks, p, k)."""
        return W if self.matrix is None else np.einsum("npi,nik->pk", W, self.matrix, optimize=True)[None]

    def squares(self, V: Float) -> Float:
        """Gather node matrices (n, 2, 2) into (blocks, k, k)."""
        if self.matrix is None:
            return V
        gathered = np.einsum("nik,nij,njl->kl", self.matrix, V, self.matrix, optimize=True)
        return np.asarray(gathered[None])

    def variances(self, covariance: Float) -> Float:
        """Variance of each node's corrections (n, 2) from the coefficients' covariance (blocks, k, k)."""
        if self.matrix is None:
            return np.asarray(np.diagonal(covariance, axis1=1, axis2=2))
        return np.asarray(np.einsum("nik,kl,nil->ni", self.matrix, covariance[0], self.matrix, optimize=True))


def correction_basis(shape: tuple[int, int], degree: int | None) -> CorrectionBasis:
    """Build the basis for (n_a, n_b) inner nodes.

    Parameters
    ----------
    shape
        Inner lines of each family.
    degree
        Degree of the polynomial that the localiser fits to a line; None where it looks at each node by itself.
    """
    if degree is None:
        return CorrectionBasis(None)
    n_a, n_b = shape
    along_a, along_b = (_polynomials(n, degree) for n in (n_b, n_a))
    per_a, per_b = along_a.shape[1], along_b.shape[1]
    matrix = np.zeros((n_a, n_b, 2, n_a * per_a + n_b * per_b))
    for i in range(n_a):  # a line of family a lies at one X; its nodes move in X as a function of Y
        matrix[i, :, 0, i * per_a : (i + 1) * per_a] = along_a
    for j in range(n_b):
        start = n_a * per_a + j * per_b
        matrix[:, j, 1, start : start + per_b] = along_b
    return CorrectionBasis(matrix.reshape(n_a * n_b, 2, -1))


def _polynomials(n: int, degree: int) -> Float:
    powers = np.vander(np.linspace(-1.0, 1.0, n), min(degree, n - 1) + 1, increasing=True)
    return np.asarray(np.linalg.qr(powers)[0])
