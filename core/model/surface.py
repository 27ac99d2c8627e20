"""The surface of a model: nodes, triangles between them, displacements of the nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import InputError

Index = NDArray[np.int64]
_FIRST = 8  # triangles tried about a point before more are
_LONG_EDGE = 2.5  # multiple of the spacing about it: an edge over a hole of a cloud of points
_STACKED = 0.05  # share of the spacing: two nodes behind one another


@dataclass(frozen=True, eq=False)
class Feet:
    """Points of a surface next to given points.

    Attributes
    ----------
    triangle
        (n,) index of the triangle.
    weight
        (n, 3) weights of its corners, sum 1.
    distance_mm
        (n,) from the given point.
    beyond_mm
        (n,) distance of the given point outside the surface's border, along the surface; 0 above its inside.
    """

    triangle: Index
    weight: Float
    distance_mm: Float
    beyond_mm: Float


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """A model's surface with its displacement, in the model's own frame or, once placed, in the system frame.

    Attributes
    ----------
    nodes_mm
        (n, 3) positions before loading.
    displacement_mm
        (n, 3) displacements.
    triangles
        (m, 3) indices of the corners.
    closed
        True for the outside of a solid: triangles then turn so that their normals point outwards.
    plane
        True if the displacement along the model's z is not known, and zero here.
    """

    nodes_mm: Float
    displacement_mm: Float
    triangles: Index
    closed: bool = False
    plane: bool = False

    def __post_init__(self) -> None:
        """Raise ``model_invalid`` for arrays that disagree, values that are not finite, a surface without area."""
        n = len(self.nodes_mm)
        if self.nodes_mm.shape != (n, 3) or self.displacement_mm.shape != (n, 3):
            raise _invalid(
                f"its nodes are {self.nodes_mm.shape} and their displacements {self.displacement_mm.shape}, both must "
                "be (n, 3)"
            )
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or len(self.triangles) == 0:
            raise _invalid("it has no triangle of its surface")
        if self.triangles.min() < 0 or self.triangles.max() >= n:
            raise _invalid(f"a triangle has a corner {self.triangles.max()}, but there are {n} nodes")
        used = np.unique(self.triangles)
        bad = ~np.isfinite(np.concatenate([self.nodes_mm[used], self.displacement_mm[used]], axis=1)).all(axis=1)
        if bad.any():
            raise _invalid(
                f"{int(bad.sum())} of its {len(used)} nodes have a position or displacement that is no number"
            )
        if not self.area_mm2.max() > 0.0:
            raise _invalid("its surface has no area")

    @cached_property
    def corners_mm(self) -> Float:
        """(m, 3, 3) corners of the triangles."""
        return np.asarray(self.nodes_mm[self.triangles])

    @cached_property
    def area_mm2(self) -> Float:
        """(m,) areas of the triangles."""
        return np.asarray(0.5 * np.linalg.norm(self._cross, axis=1))

    @cached_property
    def normals(self) -> Float:
        """(m, 3) unit normals of the triangles; zero for one without area."""
        size = np.linalg.norm(self._cross, axis=1, keepdims=True)
        return np.asarray(np.divide(self._cross, size, out=np.zeros_like(self._cross), where=size > 0.0))

    @property
    def size_mm(self) -> float:
        """Diagonal of the box about the surface."""
        used = self.nodes_mm[np.unique(self.triangles)]
        return float(np.linalg.norm(np.ptp(used, axis=0)))

    def moved(self, rotation: Float, shift_mm: Float) -> ModelSurface:
        """Return the surface with positions R x + t and displacements R u."""
        return replace(
            self, nodes_mm=self.nodes_mm @ rotation.T + shift_mm, displacement_mm=self.displacement_mm @ rotation.T
        )

    def facing(self, direction: Float) -> ModelSurface:
        """Return the side of a closed surface whose normals point along ``direction`` (3,); an open one as it is."""
        if not self.closed:
            return self
        towards = self.normals @ direction > 0.0
        return replace(self, triangles=self.triangles[towards], closed=False) if towards.any() else self

    def gradient(self, triangle: Index) -> Float:
        """Return (n, 3, 3) derivative of the displacement over the position, along the triangles' planes."""
        corners, moved = self.corners_mm[triangle], self.displacement_mm[self.triangles[triangle]]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)  # (n, 3, 2)
        change = np.swapaxes(moved[:, 1:] - moved[:, :1], 1, 2)
        return np.asarray(change @ np.linalg.pinv(edges))

    def displacement_at(self, feet: Feet) -> Float:
        """Return (n, 3) displacements, linear over each triangle."""
        return np.asarray(np.einsum("nk,nka->na", feet.weight, self.displacement_mm[self.triangles[feet.triangle]]))

    def feet(self, points_mm: Float, *, within_mm: float = np.inf) -> Feet:
        """Return the points of the surface next to ``points_mm`` (n, 3).

        For a point farther away than ``within_mm`` the result is near, not always the nearest, and the point counts as
        beyond the border.
        """
        # the triangle whose middle is nearest bounds the distance; one of another may still be nearer
        to_middle, nearest = _nearest(self._middles, points_mm, 1)
        found = nearest[:, 0]
        distance = _closest(points_mm, self.corners_mm[found])[1]
        away_from_all = to_middle[:, 0] - self._reach.max() > within_mm
        close = np.flatnonzero(~away_from_all)
        for tree, members, radius in self._classes:
            count = min(_FIRST, len(members))
            left = close
            while left.size:
                away, k = _nearest(tree, points_mm[left], count)
                near = away - self._reach[members[k]] <= distance[left][:, None] * (1.0 + 1e-12)
                near &= members[k] != found[left][:, None]
                i, j = np.nonzero(near)
                _, to = _closest(points_mm[left[i]], self.corners_mm[members[k[i, j]]])
                order = np.lexsort((to, i))
                i, j, to = i[order], j[order], to[order]
                first = np.r_[True, i[1:] != i[:-1]] if i.size else np.zeros(0, bool)
                i, j, to = i[first], j[first], to[first]
                nearer = to < distance[left[i]]
                at = left[i[nearer]]
                distance[at], found[at] = to[nearer], members[k[i[nearer], j[nearer]]]
                if count >= len(members):
                    break
                # the last one tried was near enough: there may be more
                left = left[away[:, -1] - radius <= distance[left] * (1.0 + 1e-12)]
                count = min(4 * count, len(members))
        weight, to = _closest(points_mm, self.corners_mm[found])
        foot = np.einsum("nk,nka->na", weight, self.corners_mm[found])
        away = points_mm - foot
        normal = self.normals[found]
        along = away - np.einsum("na,na->n", away, normal)[:, None] * normal
        beyond = np.where(self._on_border(found, weight), np.linalg.norm(along, axis=1), 0.0)
        return Feet(found, weight, to, np.where(away_from_all, to, beyond))

    def _on_border(self, triangle: Index, weight: Float) -> Bool:
        """(n,) True for feet on an edge that only one triangle has."""
        zero = weight <= 1e-12
        on_edge = zero & self._border[triangle]  # edge k is opposite corner k
        return np.asarray(on_edge.any(axis=1))

    @cached_property
    def _cross(self) -> Float:
        a, b, c = np.swapaxes(self.corners_mm, 0, 1)
        return np.cross(b - a, c - a)

    @cached_property
    def _border(self) -> Bool:
        """(m, 3) True where the edge opposite the corner belongs to one triangle alone."""
        edges = np.sort(self.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        _, back, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        return np.asarray((count[back.ravel()] == 1).reshape(-1, 3))

    @cached_property
    def _middles(self) -> Any:
        from scipy.spatial import cKDTree  # slow to load, and not every start needs it

        return cKDTree(self.corners_mm.mean(axis=1))

    @cached_property
    def _reach(self) -> Float:
        """(m,) largest distance of a corner from the triangle's middle."""
        return np.asarray(np.linalg.norm(self.corners_mm - self.corners_mm.mean(axis=1)[:, None], axis=2).max(axis=1))

    @cached_property
    def _classes(self) -> list[tuple[Any, Index, float]]:
        """Triangles of like size: a tree of their middles, their indices, the largest distance of a corner."""
        from scipy.spatial import cKDTree  # slow to load, and not every start needs it

        middle, reach = self.corners_mm.mean(axis=1), self._reach
        level = np.floor(np.log2(np.maximum(reach, 1e-9 * reach.max()))).astype(int)
        out: list[tuple[Any, Index, float]] = []
        for one in np.unique(level):
            members = np.flatnonzero(level == one).astype(np.int64)
            out.append((cKDTree(middle[members]), members, float(reach[members].max())))
        return out


def surface_of_cloud(nodes_mm: Float, displacement_mm: Float, towards: Float) -> ModelSurface:
    """Return the surface through points without triangles, as it is seen along a direction.

    Neighbours are joined by Delaunay's triangles in the plane normal to ``towards`` (3,); edges much longer than the
    points' spacing, over a hole or a notch of the outline, are left out.

    Raises
    ------
    InputError
        ``model_invalid`` for fewer than three points or points on one line; ``model_not_a_surface`` if points are
        behind one another.
    """
    from scipy.spatial import (  # slow to load, and not every start needs it
        Delaunay,
        QhullError,
        cKDTree,  # slow to load, and not every start needs it
    )

    axis = towards / np.linalg.norm(towards)
    plane = np.linalg.svd(axis[None])[2][1:]
    flat = nodes_mm @ plane.T
    if len(flat) < 3 or not np.isfinite(flat).all():
        raise _invalid(f"it has {len(flat)} points, or one that is no number")
    spacing = np.linalg.norm(np.ptp(flat, axis=0)) / np.sqrt(len(flat))
    tree = cKDTree(flat)
    away, nearest = _nearest(tree, flat, 2)
    apart = np.linalg.norm(nodes_mm - nodes_mm[nearest[:, 1]], axis=1)
    behind = (away[:, 1] < _STACKED * spacing) & (apart > _STACKED * spacing)
    if behind.mean() > 0.05:
        raise InputError(
            f"{int(behind.sum())} of the model's {len(flat)} points lie behind another one: they are no surface.",
            code="model_not_a_surface",
            remedy="Export the nodes of the measured surface alone, or a file with elements (VTU, XDMF).",
        )
    try:
        found = Delaunay(flat)
    except QhullError as error:
        raise _invalid("its points lie on one line") from error
    triangles = found.simplices.astype(np.int64)
    longest = np.linalg.norm(flat[triangles] - flat[np.roll(triangles, 1, axis=1)], axis=2).max(axis=1)
    near = _nearest(tree, flat, min(7, len(flat)))[0][:, 1:]
    local = np.median(near, axis=1)[triangles].max(axis=1)
    return ModelSurface(nodes_mm, displacement_mm, triangles[longest <= _LONG_EDGE * np.sqrt(2.0) * local])


def _nearest(tree: Any, points: Float, count: int) -> tuple[Float, Index]:
    """Distances and indices (n, count) of the nearest members of a tree."""
    away, index = tree.query(points, k=count)
    return away.reshape(len(points), count), index.reshape(len(points), count).astype(np.int64)


def _closest(p: Float, corners: Float) -> tuple[Float, Float]:
    """Weights (n, 3) of the corners of the point of each triangle (n, 3, 3) next to p (n, 3), and its distance (n,)."""
    a, b, c = np.swapaxes(corners, 0, 1)
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = (np.einsum("na,na->n", x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = np.einsum("na,na->n", ap, ab), np.einsum("na,na->n", ap, ac)
    area = d00 * d11 - d01 * d01
    flat = area <= 1e-24 * np.maximum(d00 * d11, 1e-300)
    safe = np.where(flat, 1.0, area)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    inside = ~flat & (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
    weight = np.column_stack([1.0 - v - w, v, w])
    distance = np.where(inside, _length(p, weight, corners), np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, second] - corners[:, first]
        square = np.einsum("na,na->n", along, along)
        t = np.einsum("na,na->n", p - corners[:, first], along) / np.where(square > 0.0, square, 1.0)
        on = np.zeros_like(weight)
        on[:, second] = np.clip(t, 0.0, 1.0)
        on[:, first] = 1.0 - on[:, second]
        to = _length(p, on, corners)
        nearer = ~inside & (to < distance)
        weight[nearer], distance[nearer] = on[nearer], to[nearer]
    return weight, distance


def _length(p: Float, weight: Float, corners: Float) -> Float:
    return np.asarray(np.linalg.norm(p - np.einsum("nk,nka->na", weight, corners), axis=1))


def _invalid(what: str) -> InputError:
    return InputError(
        f"The model is no surface with displacements: {what}.",
        code="model_invalid",
        remedy="Export the measured surface with the displacement of its nodes.",
    )
