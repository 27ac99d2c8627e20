"""A cloud of nodes as a table (CSV): positions and displacements, one row a node, units in the titles.

Programs name a vector's columns each in their own way: ``U:0``, ``U_0``, ``Points_0`` (ParaView), ``X Location (mm)``
(ANSYS), ``u (mm)`` (COMSOL), ``COORD.COOR1``, ``U.U1`` (Abaqus). A title is therefore split into the vector and
its component; columns of no vector are ignored.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.server.formats.channel_units import MAX_LINE, MAX_TITLE, title_and_unit
from stereorig.server.formats.models.mesh_file import MeshFile, is_displacement, require_count, unreadable

_AXES = {"x": 0, "y": 1, "z": 2}
#: last words of the positions' names
_POSITION = ("", "x", "points", "point", "coordinates", "coordinate", "coords", "coord", "coor", "location", "position",
             "pos", "nodes", "node")  # fmt: skip
#: names whose axis is written with them in one word: ux, dispx, xcoord, coor1
_GLUED = (*_POSITION[2:], "u", "d", "disp", "displ", "depl", "displacement", "deformation")
_NOISE = ("component", "comp", "direction", "axis")
_VECTORS = ({"0", "1"}, {"0", "1", "2"}, {"1", "2"}, {"1", "2", "3"}, {"x", "y"}, {"x", "y", "z"}, {"u", "v"}, {*"uvw"})
_UNITS = ("nm", "um", "µm", "μm", "mm", "cm", "m", "in", "inch")
_COMMENTS = ("#", "%")
_MOST_ROWS = 3_000_000
_PLAIN = "displacement"  # of the columns u, v, w, which have no name in common
_KNOWN = ("u", "d", "disp", "uu", "displacement")

Column = tuple[int, str]
"""Place of a column, and the unit in its title."""


def read_table(content: bytes, displacement: str | None = None) -> MeshFile:
    """Read a table of positions and displacements; lines before the titles and their own may begin with # or %.

    Commas, semicolons, tabs or spaces separate the columns. Units are in brackets after a title, or end it as in
    ``x_mm``; COMSOL's line ``Length unit`` holds for positions without a unit. Without a third coordinate z is 0.

    Parameters
    ----------
    content
        The file.
    displacement
        Name of a vector, or two or three titles with commas between; None: each vector whose name means a displacement.

    Raises
    ------
    FileFormatError
        ``model_unreadable``, naming the missing column or the row without numbers.
    InputError
        ``model_no_displacement`` if the named displacement is not in the table.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if max(map(len, lines), default=0) > MAX_LINE:
        raise unreadable(f"a line of its table has more than {MAX_LINE} characters")
    body = [line for line in lines if not line.startswith(_COMMENTS)]
    remarks = [line.lstrip("#% ") for line in lines if line.startswith(_COMMENTS)]
    wide = {len(line.split(mark)) for line in body[:1] for mark in {_mark(line), None}}
    found = ((line, _titles(line, body[:1])) for line in reversed(remarks))
    head = next((line for line, titles in found if len(titles) in wide and _positions(titles)), "")
    if not head:
        if not body:
            raise unreadable("it has no row of titles")
        head, body = body[0], body[1:]
    longest = max(map(len, _cells(head, _mark(head))))
    if longest > MAX_TITLE and _mark(head) is not None:
        raise unreadable(f"a title of its table has {longest} characters, at most {MAX_TITLE} are read")
    titles = _titles(head, body[:1])
    vectors, positions = _vectors(titles), _positions(titles)
    if not positions:
        raise unreadable(
            f"its table has no column {'y' if 'x' in vectors.get('', {}) else 'x'} among {head[:120]!r}",
            remedy="Give the columns x, y, z, u, v, w with their unit, as in 'x_mm,y_mm,z_mm,u_mm,v_mm,w_mm'.",
        )
    held = _displacements(titles, vectors, displacement)
    _require_once(titles, [*positions, *(one for vector in held.values() for one in vector)])
    columns = [at for at, _ in [*positions, *(one for vector in held.values() for one in vector)]]
    values = _numbers(body, columns, _mark(head), len(titles))
    units = {"": _one_unit(positions, "positions") or _length_unit(remarks)}
    points, data, at = np.zeros((len(values), 3)), {}, len(positions)
    points[:, :at] = values[:, :at]
    for name, vector in held.items():
        data[name] = values[:, at : at + len(vector)] if len(vector) > 1 else values[:, at]
        units[name] = _one_unit([c for one in held.values() for c in one] if len(vector) == 1 else vector, name)
        at += len(vector)
    return MeshFile(points, [], data, {name: unit for name, unit in units.items() if unit})


def _displacements(
    titles: Sequence[tuple[str, str]], vectors: dict[str, dict[str, Column]], wanted: str | None
) -> dict[str, list[Column]]:
    """Return the columns of each displacement by its name; of two or three titles, each by itself."""
    named = {name: found for name in vectors if (found := _vector_of(vectors, name))}
    if wanted is None:
        held = {name: found for name, found in named.items() if is_displacement(name)}
    elif "," in wanted:
        parts = [part.strip() for part in wanted.split(",")]
        places = {_plain(title): (k, unit) for k, (title, unit) in reversed(list(enumerate(titles)))}
        held = {part: [places[_plain(part)]] for part in parts} if {*map(_plain, parts)} <= places.keys() else {}
    else:
        held = {name: found for name, found in named.items() if _plain(name) == _plain(wanted)}
    if wanted is None and len(held) == 1 and _plain(name := next(iter(held))) in _KNOWN and "0" not in vectors[name]:
        return {_PLAIN: held[name]}
    if held:
        return held
    others = ", ".join(f"{name} ({len(found)})" for name, found in named.items() if name) or "none"
    remedy = "Give u, v, w (or u, v of a plane model) with their unit, or name the displacement: a vector, or its "
    remedy += "columns as 'ux,uy,uz' (--displacement, displacement)."
    if wanted is None:
        lacking = next((name for name in ("u", "v", "w") if name not in vectors.get(_PLAIN, {})), "u")
        raise unreadable(f"its table has no column {lacking}, but the vectors {others[:400]}", remedy=remedy)
    raise InputError(
        f"The model's table has no displacement {wanted[:80]!r}; its vectors, with components: {others[:400]}.",
        code="model_no_displacement",
        remedy=remedy,
    )


def _require_once(titles: Sequence[tuple[str, str]], columns: Sequence[Column]) -> None:
    """Refuse titles that differ in the case alone, as COMSOL's X of the body and x of its deformed state."""
    plain = [title.strip().lower() for title, _ in titles]
    for at, _ in columns:
        if plain.count(plain[at]) > 1:
            raise unreadable(
                f"its table has two columns {plain[at]!r}",
                remedy="Export the positions before the deformation and one displacement, each once.",
            )


def _numbers(body: Sequence[str], columns: Sequence[int], mark: str | None, titles: int) -> Float:
    """Return (n, k) numbers of some columns of each row, which has no more cells than there are titles."""
    require_count(len(columns) * len(body), "its table")
    if not body or len(body) > _MOST_ROWS:
        raise unreadable(f"its table has {len(body)} rows, 1 to {_MOST_ROWS} are read")
    values, marks = np.empty((len(body), len(columns))), set[str]()
    for k, line in enumerate(body):
        cells = _cells(line, mark) if '"' in line else line.split(mark)
        if mark is not None and any(cell.strip() for cell in cells[titles:]):
            raise unreadable(f"row {k + 1} of its table, {line[:80]!r}, has {len(cells)} cells under {titles} titles")
        try:
            held = ";".join([cells[c] for c in columns])
            marks.update(m for m in ",._" if m in held)
            values[k] = [float(cell) for cell in (held.replace(",", ".") if mark != "," else held).split(";")]
        except (ValueError, IndexError):
            raise unreadable(f"row {k + 1} of its table, {line[:80]!r}, has not {len(columns)} numbers") from None
    if "_" in marks or (mark != "," and len(marks) > 1):
        raise unreadable(
            "its numbers have points and commas, or other signs that group thousands",
            remedy="Export the numbers without groups of thousands.",
        )
    return values


def _mark(line: str) -> str | None:
    return next((m for m in ("\t", ";", ",") if m in line), None)


def _cells(line: str, mark: str | None) -> list[str]:
    if mark is None:
        return [cell.strip('"') for cell in line.split()]
    try:
        return next(csv.reader([line], delimiter=mark, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return line.split(mark)


def _titles(line: str, body: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and unit of each title; if blanks separate the titles, join the words of one title and its unit."""
    mark = _mark(line)
    cells = _cells(line, mark)
    if mark is None:
        wide = re.split(r"[ ]{2,}", line)
        if body and len(wide) == len(body[0].split()):
            cells = wide
        else:
            joined: list[str] = []
            for cell in cells:
                if cell[:1] in ("(", "[") and joined:
                    joined[-1] += f" {cell}"
                else:
                    joined.append(cell)
            cells = joined
    found = []
    for cell in cells:
        title = cell.strip().strip('"').strip()
        title = "" if len(title) > MAX_TITLE else title
        found.append((title_and_unit(title, "[(") if title.endswith((")", "]")) else None) or _ending(title))
    return found


def _vectors(titles: Sequence[tuple[str, str]]) -> dict[str, dict[str, Column]]:
    """Return the columns of each vector's components, by its name as written and the component's."""
    found: dict[str, dict[str, Column]] = {}
    shown: dict[str, str] = {}
    for k, (title, unit) in enumerate(titles):
        words = [word for word in re.findall(r"[a-z]+|[0-9]+", title.lower()) if word not in _NOISE]
        base, component = _parted(words)
        if component:
            name = shown.setdefault(" ".join(base), _named(base, component, title))
            found.setdefault(name, {}).setdefault(component, (k, unit))
    for axis in _AXES:  # x0, y0, z0: each at the beginning
        if set(found.get(axis, ())) == {"0"}:
            found.setdefault("", {}).setdefault(axis, found.pop(axis)["0"])
    return found


def _parted(words: list[str]) -> tuple[list[str], str]:
    """Return a vector's name and the component that words name; no component for a title of none."""
    if len(words) == 1 and words[0] in _AXES:
        return [], words[0]
    if len(words) == 1 and words[0] in ("u", "v", "w"):
        return [_PLAIN], words[0]
    if len(words) > 1 and (words[-1] in _AXES or (words[-1].isascii() and words[-1].isdigit())):
        return words[:-1], words[-1]
    if len(words) > 1 and words[0] in _AXES:
        return words[1:], words[0]
    last = words[-1] if words else ""
    if last[:-1] in _GLUED and last[-1] in _AXES:
        return [*words[:-1], last[:-1]], last[-1]
    if last[1:] in _GLUED and last[0] in _AXES:
        return [*words[:-1], last[1:]], last[0]
    return [], ""


def _named(base: list[str], component: str, title: str) -> str:
    """Return a vector's name: its kind for a position, else the name as written."""
    if not base or base[-1] in (*_POSITION, *_AXES):
        return base[-1] if base else ""
    end = len(title) - len(component)
    return title[:end].rstrip(" .:_,;-") if title.lower().endswith(component) and end else " ".join(base)


def _vector_of(vectors: dict[str, dict[str, Column]], name: str) -> list[Column]:
    """Return the columns of a vector in the order of its components; empty if it has not all of them."""
    parts = vectors.get(name, {})
    return [parts[component] for component in sorted(parts)] if set(parts) in _VECTORS else []


def _positions(titles: Sequence[tuple[str, str]]) -> list[Column]:
    vectors = _vectors(titles)
    return next((found for name in _POSITION if (found := _vector_of(vectors, name))), [])


def _length_unit(remarks: Sequence[str]) -> str:
    stated = next((line for line in remarks if line.lower().startswith("length unit")), "")
    return stated[len("length unit") :].strip(' :,;\t"')


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _ending(title: str) -> tuple[str, str]:
    """Return a title's name and the unit that ends it, as in ``x_mm``."""
    ending = next((unit for unit in _UNITS if title.lower().endswith(tuple(f"{mark}{unit}" for mark in "_ /"))), "")
    name = title[: len(title) - len(ending) - 1] if ending else ""
    return (name, title[len(name) + 1 :]) if name else (title, "")


def _one_unit(columns: Sequence[Column], name: str) -> str:
    units = {unit for _, unit in columns}
    if len(units) > 1:
        raise unreadable(
            f"its columns of {name} have different units: {', '.join(sorted(u or 'none' for u in units))}",
            remedy="Give one unit for positions and one for displacements.",
        )
    return units.pop()
