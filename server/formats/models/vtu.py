"""VTK's unstructured grids in XML (VTU)."""

from __future__ import annotations

from typing import Any

import numpy as np
from defusedxml import ElementTree as Xml
from defusedxml.common import DefusedXmlException

from core.arrays import Float
from server.formats.models.cells import NODES
from server.formats.models.mesh_file import Index, MeshFile, require_count, unreadable
from server.formats.models.vtk_data import Decoder

_MOST_NODES = 64  # of a cell


def read_vtu(content: bytes) -> MeshFile:
    """Read a file; its pieces become one mesh.

    Raises
    ------
    FileFormatError
        ``model_unreadable``.
    """
    xml, appended, is_text = _without_appended(content)
    try:
        root = Xml.fromstring(xml)
    except (Xml.ParseError, DefusedXmlException, ValueError) as error:
        raise unreadable(f"it is no XML ({error})") from error
    grid = root.find("UnstructuredGrid")
    if root.tag != "VTKFile" or grid is None:
        raise unreadable(f"it is a {root.get('type') or root.tag}, not VTK's UnstructuredGrid")
    decoder = Decoder.of(root.attrib, appended, appended_base64=is_text)
    pieces = [_piece(one, decoder) for one in grid.findall("Piece")]
    if not pieces:
        raise unreadable("it has no piece")
    units: dict[str, str] = {}
    for _, _, _, stated in pieces:
        units |= stated
    begin = np.cumsum([0, *(len(points) for points, _, _, _ in pieces)])
    names = set.intersection(*(set(data) for _, _, data, _ in pieces))
    return MeshFile(
        np.concatenate([points for points, _, _, _ in pieces]),
        [(kind, cells + start) for (_, held, _, _), start in zip(pieces, begin, strict=False) for kind, cells in held],
        {name: np.concatenate([data[name] for _, _, data, _ in pieces]) for name in names},
        units,
    )


_Piece = tuple[Float, list[tuple[int, Index]], dict[str, Float], dict[str, str]]


def _piece(element: Any, decoder: Decoder) -> _Piece:
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
        name, parts = array.get("Name") or "", max(1, int(array.get("NumberOfComponents") or 1))
        if not name or array.get("type") == "String" or parts > 9:
            continue
        values = decoder.array(array, most=parts * n).astype(np.float64)
        if values.size != parts * n:
            raise unreadable(f"the array {name} has {values.size} numbers for {n} points of {parts} components")
        data[name] = values if parts == 1 else values.reshape(n, parts)
        _note_unit(array, name, units)
    return xyz.reshape(n, 3), _cells(element, decoder, n, m), data, units


def _cells(element: Any, decoder: Decoder, n: int, m: int) -> list[tuple[int, Index]]:
    arrays = {one.get("Name"): one for one in element.findall("Cells/DataArray")}
    if m == 0 or not {"connectivity", "offsets", "types"} <= set(arrays):
        return []
    kinds = decoder.array(arrays["types"], most=m).astype(np.int64)
    ends = decoder.array(arrays["offsets"], most=m).astype(np.int64)
    nodes = decoder.array(arrays["connectivity"], most=_MOST_NODES * m).astype(np.int64)
    begins = np.r_[0, ends[:-1]]
    if len(kinds) != m or len(ends) != m or (ends < begins).any() or (m and ends[-1] > len(nodes)):
        raise unreadable(f"its {m} cells have {len(kinds)} kinds and {len(ends)} ends over {len(nodes)} nodes")
    if len(nodes) and not (nodes.min() >= 0 and nodes.max() < n):
        raise unreadable(f"a cell has the node {nodes.max()}, but there are {n}")
    out = []
    for kind in np.unique(kinds):
        of_kind = kinds == kind
        count = NODES.get(int(kind))
        if count is None:
            out.append((int(kind), np.zeros((int(of_kind.sum()), 0), np.int64)))
            continue
        if (ends[of_kind] - begins[of_kind] != count).any():
            raise unreadable(f"a cell of VTK's kind {kind} has other than {count} nodes")
        out.append((int(kind), nodes[begins[of_kind][:, None] + np.arange(count)]))
    return out


def _count(element: Any, name: str) -> int:
    try:
        count = int(element.get(name, ""))
    except ValueError:
        raise unreadable(f"a piece does not say its {name}") from None
    require_count(3 * count, "a piece")
    return count


def _note_unit(array: Any, name: str, units: dict[str, str]) -> None:
    for key in array.findall("InformationKey"):
        if key.get("name") == "UNITS_LABEL" and (key.text or "").strip():
            units[name] = key.text.strip()


def _without_appended(content: bytes) -> tuple[bytes, bytes, bool]:
    """Return the file without what is appended to it, which may be no XML, that, and True if it is base64."""
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
