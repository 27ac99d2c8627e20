"""The surface of a mesh: shells as they are, of solids the outside; quadratic cells keep their nodes on edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.errors import InputError
from server.formats.models.mesh_file import Index, MeshFile

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
#: nodes of each kind of cell that a surface is made of
NODES = _FLAT | {kind: solid.nodes for kind, solid in _SOLIDS.items()}


def triangles_of(mesh: MeshFile) -> tuple[Index, bool]:
    """Return (m, 3) triangles of a mesh's surface, and True if it is the outside of solids.

    Raises
    ------
    InputError
        ``model_no_surface`` where no cell is flat or solid.
    """
    solid = any(kind in _SOLIDS for kind, _ in mesh.cells)
    faces: dict[int, list[Index]] = {}
    for kind, cells in mesh.cells:
        if kind in _SOLIDS and len(cells):
            for corners in _SOLIDS[kind].with_middles():
                faces.setdefault(len(corners), []).append(cells[:, corners])
        elif kind in _FLAT and len(cells) and not solid:
            faces.setdefault(_FLAT[kind], []).append(cells)
    if not faces:
        kinds = sorted({kind for kind, cells in mesh.cells if len(cells)})
        raise InputError(
            f"The model has no cells of a surface or solid; it has VTK's kinds {kinds}.",
            code="model_no_surface",
            remedy="Export triangles, quadrilaterals, tetrahedra, hexahedra, wedges or pyramids.",
        )
    whole = {count: np.concatenate(parts) for count, parts in faces.items()}
    if solid:
        whole = {count: cells[alone] for (count, cells), alone in zip(whole.items(), _outside(whole), strict=True)}
    triangles = [cells[:, three] for count, cells in whole.items() for three in _SPLIT[count]]
    return np.concatenate(triangles), solid


def _outside(faces: dict[int, Index]) -> list[np.ndarray]:
    """Return for each group of faces True where it belongs to one solid alone."""
    keys = []
    for count, cells in faces.items():
        corners = {3: 3, 4: 4, 6: 3, 8: 4}[count]
        key = np.full((len(cells), 4), -1, np.int64)
        key[:, :corners] = np.sort(cells[:, :corners], axis=1)
        keys.append(key)
    _, back, times = np.unique(np.concatenate(keys), axis=0, return_inverse=True, return_counts=True)
    alone = times[back.ravel()] == 1
    return np.split(alone, np.cumsum([len(key) for key in keys])[:-1])
