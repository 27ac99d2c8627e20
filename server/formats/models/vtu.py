"""VTK's unstructured grids in XML (VTU)."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.formats.models.cells import NODES, plain_cells
from stereorig.server.formats.models.mesh_file import (
    Index,
    MeshFile,
    require_count,
    require_nodes,
    unreadable,
    whole_number,
)
from stereorig.server.formats.models.vtk_data import Decoder
from stereorig.server.formats.xml_tree import read_xml

_MOST_NODES, _MOST_SHARED = 64, 4  # of a cell, and of long strips, of a node


def read_vtu(content: bytes) -> MeshFile:
    """Read a file; its pieces become one mesh.

    Raises
    ------
    FileFormatError
        ``model_unreadable``.
    """
    xml, appended, is_text = _without_appended(content)
    try:
        root = read_xml(xml)
    except ValueError as error:
        raise unreadable(f"it is no XML ({error})") from error
    grid = root.find("UnstructuredGrid")
    if root.tag != "VTKFile" or grid is None:
        raise unreadable(f"it is {root.get('type') or root.tag}, and has no UnstructuredGrid of a VTKFile")
    decoder = Decoder.of(root.attrib, appended, appended_base64=is_text)
    pieces = [_piece(one, decoder) for one in grid.findall("Piece")]
    if not pieces:
        raise unreadable("it has no piece")
    units: dict[str, str] = {}
    for piece in pieces:
        units |= piece.units
    begin = np.cumsum([0, *(len(piece.points) for piece in pieces)])
    names = set.intersection(*(set(piece.data) for piece in pieces))
    return MeshFile(
        np.concatenate([piece.points for piece in pieces]),
        [(kind, cells + start) for piece, start in zip(pieces, begin, strict=False) for kind, cells in piece.cells],
        {name: np.concatenate([piece.data[name] for piece in pieces]) for name in names},
        units,
        corners_only=sum(piece.corners_only for piece in pieces),
    )


def _piece(element: Any, decoder: Decoder) -> MeshFile:
    n, m = (_count(element, name) for name in ("NumberOfPoints", "NumberOfCells"))
    units: dict[str, str] = {}
    points = element.find("Points/DataArray")
    if points is None:
        raise unreadable("a piece has no points")
    xyz = decoder.array(points, most=3 * n).astype(np.float64)
    if xyz.size != 3 * n:
        raise unreadable(f"{n} points have {xyz.size} coordinates")
    _note_unit(points, "", units)
    data: dict[str, Float] = {}
    for array in element.findall("PointData/DataArray"):
        name = array.get("Name") or ""
        parts = whole_number(array.get("NumberOfComponents") or "1", "a number of components") or 1
        if not name or array.get("type") == "String" or parts > 9:
            continue
        values = decoder.array(array, most=parts * n).astype(np.float64)
        if values.size != parts * n:
            raise unreadable(f"the array {name} has {values.size} numbers for {n} points of {parts} components")
        data[name] = values if parts == 1 else values.reshape(n, parts)
        _note_unit(array, name, units)
    cells, corners_only = _cells(element, decoder, n, m)
    return MeshFile(xyz.reshape(n, 3), cells, data, units, corners_only=corners_only)


def _cells(element: Any, decoder: Decoder, n: int, m: int) -> tuple[list[tuple[int, Index]], int]:
    """Return the cells by their kind, and the number of cells that were reduced to their corners."""
    arrays = {one.get("Name"): one for one in element.findall("Cells/DataArray")}
    if m == 0 or not {"connectivity", "offsets", "types"} <= set(arrays):
        return [], 0
    kinds, ends = (_whole(decoder.array(arrays[name], most=m)) for name in ("types", "offsets"))
    nodes = require_nodes(decoder.array(arrays["connectivity"], most=_MOST_NODES * m + _MOST_SHARED * n), n)
    begins = np.r_[0, ends[:-1]]
    if len(kinds) != m or len(ends) != m or (ends < begins).any() or (m and ends[-1] > len(nodes)):
        raise unreadable(f"its {m} cells have {len(kinds)} kinds and {len(ends)} ends over {len(nodes)} nodes")
    out, corners_only, counts = [], 0, ends - begins
    for kind, count in ((k, c) for k in np.unique(kinds).tolist() for c in np.unique(counts[kinds == k]).tolist()):
        if count != NODES.get(kind, count):
            raise unreadable(f"a cell of VTK's kind {kind} has other than {NODES[kind]} nodes")
        alike = begins[(kinds == kind) & (counts == count)]
        plain, cells, reduced = plain_cells(kind, nodes[alike[:, None] + np.arange(count)])
        out.append((plain, cells))
        corners_only += reduced * len(cells)
    return out, corners_only


def _whole(numbers: Any) -> Index:
    """Return numbers as whole ones; -1 in place of one that is none."""
    return np.where(np.abs(numbers.astype(np.float64)) < 2**53, numbers, -1).astype(np.int64)


def _count(element: Any, name: str) -> int:
    count = whole_number(element.get(name), f"{name} of a piece")
    require_count(3 * count, "a piece")
    return count


def _note_unit(array: Any, name: str, units: dict[str, str]) -> None:
    for key in array.findall("InformationKey"):
        if key.get("name") == "UNITS_LABEL" and (key.text or "").strip():
            units[name] = key.text.strip()


def _without_appended(content: bytes) -> tuple[bytes, bytes, bool]:
    """Return the file without its appended data, which may be no XML; the appended data; True if they are base64."""
    begin = content.find(b"<AppendedData")
    if begin < 0:
        return content, b"", False
    opened = content.find(b">", begin)
    mark, end = content.find(b"_", opened), content.rfind(b"</AppendedData>")
    if opened < 0 or mark < 0 or end < mark:
        raise unreadable("its appended data have no end: it was cut short")
    head = content[begin : opened + 1]
    is_text = b"base64" in head
    appended = content[mark + 1 : end]
    return (
        content[:begin] + content[end + len(b"</AppendedData>") :],
        appended.strip() if is_text else appended,
        is_text,
    )
