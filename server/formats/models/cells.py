"""The surface of a mesh: shells as they are, the outside of solids; quadratic cells keep their nodes on edges.

Polygons, strips, pixels and voxels keep their form; other cells of higher order are reduced to their corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.server.formats.models.mesh_file import Index, MeshFile

_TRIANGLE = ((0, 1, 2),)
_QUAD = ((0, 1, 2), (0, 2, 3))
_TRIANGLE_6 = ((0, 3, 5), (1, 4, 3), (2, 5, 4), (3, 4, 5))
_QUAD_8 = ((0, 4, 7), (1, 5, 4), (2, 6, 5), (3, 7, 6), (4, 5, 6), (4, 6, 7))
_QUAD_9 = ((0, 4, 8), (0, 8, 7), (1, 5, 8), (1, 8, 4), (2, 6, 8), (2, 8, 5), (3, 7, 8), (3, 8, 6))
_SPLIT = {3: _TRIANGLE, 4: _QUAD, 6: _TRIANGLE_6, 8: _QUAD_8, 9: _QUAD_9}
#: VTK's number of each kind of flat cell, and its number of nodes
_FLAT = {5: 3, 9: 4, 22: 6, 23: 8, 28: 9}
_TET = ((0, 1, 3), (1, 2, 3), (2, 0, 3), (0, 2, 1))
_HEX = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))
_TET_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
_HEX_EDGES = (*((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6)), *((6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)))


@dataclass(frozen=True)
class _Solid:
    nodes: int
    faces: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int], ...] = ()

    def with_middles(self) -> list[tuple[int, ...]]:
        """Return the nodes of each face: corners, then those in the middle of its edges."""
        if not self.edges:
            return list(self.faces)
        corners = 1 + max(max(edge) for edge in self.edges)
        number = {frozenset(edge): corners + k for k, edge in enumerate(self.edges)}
        return [(*f, *(number[frozenset((f[i], f[(i + 1) % len(f)]))] for i in range(len(f)))) for f in self.faces]


_SOLIDS = {
    10: _Solid(4, _TET),
    12: _Solid(8, _HEX),
    13: _Solid(6, ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0))),
    14: _Solid(5, ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))),
    24: _Solid(10, _TET, _TET_EDGES),
    25: _Solid(20, _HEX, _HEX_EDGES),
}
_POLYGON, _QUADRATIC_POLYGON, _STRIP = 7, 36, 6
_MOST_SIDES = 64  # of a polygon: the work grows with their square
_REORDERED = {8: (9, (0, 1, 3, 2)), 11: (12, (0, 1, 3, 2, 4, 5, 7, 6))}  # pixels and voxels go row by row
#: Lagrange's cells whose nodes have the same order as VTK's older kinds, by number of nodes
_SAME = {(69, 6): 22, (70, 9): 28, (71, 10): 24}
#: of other cells of higher order (quadratic, Lagrange's, Bezier's) the kind that their corners make, and how many
_CORNERS = dict.fromkeys((34, 69, 76), (5, 3)) | dict.fromkeys((30, 70, 77), (9, 4)) | dict.fromkeys((71, 78), (10, 4))
_CORNERS |= dict.fromkeys((29, 33, 72, 79), (12, 8)) | dict.fromkeys((26, 31, 32, 73, 80), (13, 6))
_CORNERS |= dict.fromkeys((27, 74, 81), (14, 5))
#: nodes of each kind of cell that a surface is made of
NODES = _FLAT | {kind: solid.nodes for kind, solid in _SOLIDS.items()}


def plain_cells(kind: int, nodes: Index) -> tuple[int, Index, bool]:
    """Return VTK's cells of one kind as those that a surface is made of, and True if only their corners are left.

    Parameters
    ----------
    kind
        VTK's number.
    nodes
        (m, k) of cells of k nodes each.

    Returns
    -------
    tuple
        A kind of ``NODES``, or polygons; cells of no other kind have no nodes left.
    """
    count = nodes.shape[1]
    if count == NODES.get(kind) or (kind == _POLYGON and 3 <= count <= _MOST_SIDES):
        return kind, nodes, False
    if kind in _REORDERED and count == len(_REORDERED[kind][1]):
        return _REORDERED[kind][0], nodes[:, _REORDERED[kind][1]], False
    if kind == _STRIP and count >= 3:  # every other triangle turns the other way
        turned = [nodes[:, [k, k + 1 + k % 2, k + 2 - k % 2]] for k in range(count - 2)]
        return 5, np.concatenate(turned), False
    if kind == _QUADRATIC_POLYGON and 6 <= count <= 2 * _MOST_SIDES:
        return _POLYGON, nodes[:, : count // 2], True
    if (kind, count) in _SAME:
        return _SAME[kind, count], nodes, False
    likely, corners = _CORNERS.get(kind, (kind, count + 1))
    if count < corners:
        return kind, nodes[:, :0], False
    return likely, nodes[:, :corners], count > corners


def triangles_of(mesh: MeshFile) -> tuple[Index, bool]:
    """Return (m, 3) triangles of a mesh's surface, and True if it is the outside of solids.

    Raises
    ------
    InputError
        ``model_no_surface`` if no cell is flat or solid.
    """
    solid = any(kind in _SOLIDS for kind, _ in mesh.cells)
    faces: dict[int, list[Index]] = {}
    for kind, cells in mesh.cells:
        if kind in _SOLIDS and len(cells):
            for corners in _SOLIDS[kind].with_middles():
                faces.setdefault(len(corners), []).append(cells[:, corners])
        elif kind in _FLAT and len(cells) and not solid:
            faces.setdefault(_FLAT[kind], []).append(cells)
        elif kind == _POLYGON and len(cells) and not solid:
            faces.setdefault(3, []).append(_fans(cells, mesh.points))
    if not faces:
        kinds = sorted({kind for kind, cells in mesh.cells if len(cells)})
        raise InputError(
            f"The model has no cells of a surface or solid; it has VTK's kinds {kinds}.",
            code="model_no_surface",
            remedy="Export triangles, quadrilaterals, polygons, tetrahedra, hexahedra, wedges or pyramids.",
        )
    whole = {count: np.concatenate(parts) for count, parts in faces.items()}
    if solid:
        whole = {count: cells[alone] for (count, cells), alone in zip(whole.items(), _outside(whole), strict=True)}
    triangles = [cells[:, three] for count, cells in whole.items() for three in _SPLIT[count]]
    return np.concatenate(triangles), solid


def _fans(polygons: Index, points: Float) -> Index:
    """Return the triangles of polygons (m, k), about the first corner from which all turn alike, if there is one."""
    m, k = polygons.shape
    out, left = np.zeros((m, k - 2, 3), np.int64), np.arange(m)
    for start in range(k):
        turned = np.roll(polygons[left], -start, axis=1)
        fan = np.stack([np.broadcast_to(turned[:, :1], (len(left), k - 2)), turned[:, 1:-1], turned[:, 2:]], axis=-1)
        a, b, c = np.moveaxis(points[fan], 2, 0)
        normal = np.cross(b - a, c - a)
        alike = (np.einsum("mta,ma->mt", normal, normal.sum(axis=1)) >= 0.0).all(axis=1)
        chosen = alike | (start == 0)
        out[left[chosen]] = fan[chosen]
        left = left[~alike]
    return out.reshape(-1, 3)


def _outside(faces: dict[int, Index]) -> list[np.ndarray]:
    """Return for each group of faces True at the faces that belong to one solid alone."""
    keys = []
    for count, cells in faces.items():
        corners = {3: 3, 4: 4, 6: 3, 8: 4}[count]
        key = np.full((len(cells), 4), -1, np.int64)
        key[:, :corners] = np.sort(cells[:, :corners], axis=1)
        keys.append(key)
    _, back, times = np.unique(np.concatenate(keys), axis=0, return_inverse=True, return_counts=True)
    alone = times[back.ravel()] == 1
    return np.split(alone, np.cumsum([len(key) for key in keys])[:-1])
