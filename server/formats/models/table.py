"""A cloud of nodes as a table (CSV): positions and displacements, one row a node, units in the titles."""

from __future__ import annotations

import re

import numpy as np

from server.formats.models.mesh_file import MeshFile, require_count, unreadable

_NAMES = {
    "x": ("x", "x0", "xcoord", "coordx", "xcoordinate", "nodex"),
    "y": ("y", "y0", "ycoord", "coordy", "ycoordinate", "nodey"),
    "z": ("z", "z0", "zcoord", "coordz", "zcoordinate", "nodez"),
    "u": ("u", "ux", "dx", "u1", "uu1", "dispx", "displacementx", "displacement0"),
    "v": ("v", "uy", "dy", "u2", "uu2", "dispy", "displacementy", "displacement1"),
    "w": ("w", "uz", "dz", "u3", "uu3", "dispz", "displacementz", "displacement2"),
}
_UNITS = ("nm", "um", "µm", "μm", "mm", "cm", "m", "in", "inch")
_BRACKETS = re.compile(r"^(?P<name>.*?)\s*[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]$")
_ENDING = re.compile(rf"^(?P<name>.+?)[_ /](?P<unit>{'|'.join(_UNITS)})$", re.IGNORECASE)
_MOST_ROWS = 3_000_000


def read_table(content: bytes) -> MeshFile:
    """Read a table with the columns x, y, z and u, v, w (or ux, uy, uz); lines before the titles may begin with #.

    Columns are parted by commas, semicolons, tabs or spaces. Units stand in brackets behind a title, or end it as in
    ``x_mm``.

    Raises
    ------
    FileFormatError
        ``model_unreadable``, naming the column that lacks or the row that is no numbers.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    while lines and lines[0].startswith("#") and not _titles(lines[0].lstrip("# ")):
        lines = lines[1:]
    if not lines:
        raise unreadable("it has no row of titles")
    head = lines[0].lstrip("# ")
    mark = next((m for m in ("\t", ";", ",") if m in head), None)
    found = _titles(head)
    lacking = [name for name in _NAMES if name not in found]
    if lacking:
        raise unreadable(
            f"its table has no column {lacking[0]} among {head[:120]!r}",
            remedy="Give the columns x, y, z, u, v, w with their unit, as in 'x_mm,y_mm,z_mm,u_mm,v_mm,w_mm'.",
        )
    body = [line for line in lines[1:] if not line.startswith("#")]
    require_count(6 * len(body), "its table")
    if not body or len(body) > _MOST_ROWS:
        raise unreadable(f"its table has {len(body)} rows, 1 to {_MOST_ROWS} are read")
    values = np.empty((len(body), 6))
    columns = [found[name][0] for name in _NAMES]
    for k, line in enumerate(body):
        cells = line.split(mark)
        try:
            values[k] = [float(cells[c].replace(",", ".") if mark != "," else cells[c]) for c in columns]
        except (ValueError, IndexError):
            raise unreadable(f"row {k + 1} of its table, {line[:80]!r}, has not six numbers") from None
    units = {"": _one_unit(found, "xyz"), "displacement": _one_unit(found, "uvw")}
    return MeshFile(
        values[:, :3], [], {"displacement": values[:, 3:]}, {name: unit for name, unit in units.items() if unit}
    )


def _titles(line: str) -> dict[str, tuple[int, str]]:
    """Return column and unit of each known title."""
    mark = next((m for m in ("\t", ";", ",") if m in line), None)
    found: dict[str, tuple[int, str]] = {}
    for k, cell in enumerate(line.split(mark)):
        title = cell.strip().strip('"').strip()
        match = _BRACKETS.match(title) or _ENDING.match(title)
        name, unit = (match["name"], match["unit"]) if match else (title, "")
        plain = re.sub(r"[^a-z0-9]", "", name.lower())
        for wanted, names in _NAMES.items():
            if plain in names:
                found.setdefault(wanted, (k, unit))
    return found


def _one_unit(found: dict[str, tuple[int, str]], names: str) -> str:
    units = {found[name][1] for name in names}
    if len(units) > 1:
        raise unreadable(
            f"its columns {', '.join(names)} have different units: {', '.join(sorted(u or 'none' for u in units))}",
            remedy="Give one unit for positions and one for displacements.",
        )
    return units.pop()
