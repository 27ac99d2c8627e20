"""XDMF: light data in XML; heavy data in the same XML, or in HDF5 files of the same folder."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.formats.hdf5_parts import require_own_parts
from stereorig.server.formats.models.cells import NODES, plain_cells
from stereorig.server.formats.models.mesh_file import (
    Index,
    MeshFile,
    require_count,
    require_nodes,
    unreadable,
    whole_number,
)
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.formats.xml_tree import read_xml

#: XDMF's name and number of each kind of cell, and VTK's
_KINDS = {
    "triangle": (4, 5),
    "quadrilateral": (5, 9),
    "tetrahedron": (6, 10),
    "pyramid": (7, 14),
    "wedge": (8, 13),
    "hexahedron": (9, 12),
    "triangle_6": (36, 22),
    "tri_6": (36, 22),
    "quadrilateral_9": (35, 28),
    "quad_9": (35, 28),
    "quadrilateral_8": (37, 23),
    "quad_8": (37, 23),
    "tetrahedron_10": (38, 24),
    "tet_10": (38, 24),
    "hexahedron_20": (48, 25),
    "hex_20": (48, 25),
    "pyramid_13": (39, 27),
    "wedge_15": (40, 26),
    "wedge_18": (41, 32),
    "hexahedron_24": (49, 33),
    "hex_24": (49, 33),
    "hexahedron_27": (50, 29),
    "hex_27": (50, 29),
}
_NODES = NODES | {27: 13, 26: 15, 32: 18, 33: 24, 29: 27}
_POLYGON = 3, 7
_BY_NUMBER = dict(_KINDS.values())
_COUNTED = (1, 2, _POLYGON[0])  # kinds in a mixed list that state their number of nodes
_COMPONENTS = {"scalar": 1, "vector": 3, "tensor": 9, "tensor6": 6}
#: path of a file of heavy data, and its content if the file is not to be opened
Heavy = Callable[[str], tuple[Path, Any]]


def read_xdmf(content: bytes, heavy: Heavy, *, time: float | None = None) -> MeshFile:
    """Read a file.

    Parameters
    ----------
    content
        The light data.
    heavy
        Gives a file of heavy data by its name, or raises an error.
    time
        The state nearest to this time of a series; None: the last.

    Raises
    ------
    FileFormatError
        ``model_unreadable``; errors that ``heavy`` raises.
    """
    try:
        root = read_xml(content)
    except ValueError as error:
        raise unreadable(f"it is no XML ({error})") from error
    if not root.tag.lower().endswith("xdmf"):
        raise unreadable(f"it begins with {root.tag!r}, not with Xdmf")
    grids = [one for one in root.iter("Grid") if one.get("GridType", "Uniform") == "Uniform"]
    if not grids:
        raise unreadable("it has no grid")
    at = [_time(one) for one in grids]
    held = [k for k, one in enumerate(grids) if one.find("Attribute") is not None] or list(range(len(grids)))
    k = held[-1] if time is None else min(held, key=lambda i: _away(at[i], time))
    grid = grids[k]
    # later states of a series refer to the mesh of the first
    topology, geometry = (_first(grid, root, name) for name in ("Topology", "Geometry"))
    if geometry is None:
        raise unreadable("it has no geometry")
    items = {item.get("Name"): item for item in root.iter("DataItem") if item.get("Name")}

    def numbers(element: Any) -> Float:
        item = element.find("DataItem") if element.tag != "DataItem" else element
        if item is None:
            raise unreadable(f"a {element.tag} has no data")
        reference = item.get("Reference")
        if reference is not None:
            name = reference if reference != "XML" else (item.text or "").strip()
            item = next((one for key, one in items.items() if key and f'"{key}"' in name), item)
        return _numbers(item, heavy)

    xyz = numbers(geometry)
    parts = 2 if geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper() == "XY" else 3
    if xyz.size % parts or not xyz.size:
        raise unreadable(f"its geometry has {xyz.size} numbers, no multiple of {parts}")
    points = xyz.reshape(-1, parts)
    if parts == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    n, data, units = len(points), {}, {}
    stated = _unit(geometry)
    if stated:
        units[""] = stated
    for one in grid.findall("Attribute"):
        name = one.get("Name") or ""
        if one.get("Center", "Node") != "Node" or not name:
            continue
        values = numbers(one)
        count = _COMPONENTS.get(one.get("AttributeType", "Scalar").lower(), 0)
        if values.size % max(n, 1) or (
            count and values.size != count * n and values.size // max(n, 1) not in (1, 2, 3)
        ):
            raise unreadable(f"the attribute {name} has {values.size} numbers for {n} nodes")
        data[name] = values.reshape(n, -1) if values.size != n else values.ravel()
        if _unit(one):
            units[name] = _unit(one)
    plain = [] if topology is None else [plain_cells(*one) for one in _cells(topology, numbers(topology), n)]
    cells = [(kind, nodes) for kind, nodes, _ in plain]
    corners_only = sum(len(nodes) for _, nodes, reduced in plain if reduced)
    return MeshFile(points.astype(np.float64), cells, data, units, at[k], corners_only)


def _away(at: float | None, time: float) -> float:
    return math.inf if at is None else abs(at - time)


def _time(grid: Any) -> float | None:
    found = grid.find("Time")
    try:
        return None if found is None else float(found.get("Value", ""))
    except ValueError:
        return None


def _first(grid: Any, root: Any, name: str) -> Any:
    own = grid.find(name)
    return own if own is not None else next(root.iter(name), None)


def _unit(element: Any) -> str:
    for one in element.findall("Information"):
        if one.get("Name", "").lower() in ("unit", "units"):
            return (one.get("Value") or one.text or "").strip()
    return ""


def _numbers(item: Any, heavy: Heavy) -> Float:
    shape = [whole_number(v, "a data item's dimension") for v in item.get("Dimensions", "").split()]
    count = math.prod(shape)
    require_count(count, "a data item")
    text, form = (item.text or "").strip(), item.get("Format", "XML").upper()
    if form == "XML":
        try:
            values = np.array(text.split(None, count)[:count], dtype=np.float64)
        except ValueError as error:
            raise unreadable(f"a data item holds text that is no number ({error})") from error
    elif form in ("HDF", "HDF5"):
        name, _, inside = text.partition(":")
        values = _from_hdf(heavy(name), inside, count)
    else:
        raise unreadable(f"a data item has the format {form}", remedy="Write the heavy data as HDF5 or XML.")
    if shape and values.size != count:
        raise unreadable(f"a data item has {values.size} of {count} numbers: the file was cut short")
    return values.astype(np.float64)


def _from_hdf(file: tuple[Path, Any], inside: str, count: int) -> Float:
    path, content = file
    parts = [part for part in inside.split("/") if part]
    if content is None or isinstance(content, bytes):  # an open data set was looked through before
        require_own_parts(path, content)
    with opened(path, content) as data:
        group: Any = data
        for part in parts[:-1]:
            group = getattr(group, "groups", {}).get(part)
        held = None if group is None or not parts else group.variables.get(parts[-1])
        if held is None:
            raise unreadable(f"{path.name} has no data set {inside}")
        require_count(int(held.size), f"{path.name}:{inside}")
        if held.size < count:
            raise unreadable(f"{path.name}:{inside} has {held.size} of {count} numbers")
        try:
            return np.asarray(held[...], dtype=np.float64).ravel()
        except (OSError, RuntimeError, ValueError, TypeError, IndexError) as error:
            raise unreadable(f"{path.name}:{inside} is damaged, or holds no numbers") from error


def _cells(topology: Any, flat: Float, n: int) -> list[tuple[int, Index]]:
    name = topology.get("TopologyType", topology.get("Type", "")).lower()
    if name == "mixed":
        if not (np.abs(flat) < 2**53).all():
            raise unreadable("its mixed topology holds a number that is not whole")
        found = _mixed(flat.astype(np.int64))
        for _, cells in found:
            require_nodes(cells.ravel(), n)
    elif name in _KINDS or name == "polygon":
        kind = _KINDS.get(name, _POLYGON)[1]
        count = _NODES.get(kind) or whole_number(topology.get("NodesPerElement"), "NodesPerElement of its polygons")
        if count < 1 or flat.size % count:
            raise unreadable(f"its topology {name} has {flat.size} nodes, no multiple of {count}")
        found = [(kind, require_nodes(flat, n).reshape(-1, count))]
    else:
        return []
    return found


def _mixed(nodes: Index) -> list[tuple[int, Index]]:
    lists: dict[tuple[int, int], list[Index]] = {}
    at = 0
    while at < len(nodes):
        number, begin = int(nodes[at]), at + 1
        if number in _COUNTED and begin < len(nodes):
            kind, count, begin = (_POLYGON[1] if number == _POLYGON[0] else 0), max(0, int(nodes[begin])), begin + 1
        else:
            kind = _BY_NUMBER.get(number, -1)
            count = _NODES.get(kind, 0)
        at = begin + count
        if kind < 0 or at > len(nodes):
            raise unreadable(f"its mixed topology has a cell of an unknown kind at number {begin}, or ends inside one")
        if kind:
            lists.setdefault((kind, count), []).append(nodes[begin:at])
    return [(kind, np.stack(cells)) for (kind, _), cells in lists.items()]
