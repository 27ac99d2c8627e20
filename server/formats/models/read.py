"""A model's file as a surface in millimetres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, get_args

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import FileFormatError, InputError
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.formats.models.cells import triangles_of
from stereorig.server.formats.models.mesh_file import DISPLACEMENT, MeshFile, is_displacement, unreadable
from stereorig.server.formats.models.table import read_table
from stereorig.server.formats.models.vtu import read_vtu
from stereorig.server.formats.models.xdmf import read_xdmf

if TYPE_CHECKING:
    from stereorig.core.model.surface import ModelSurface


Unit = Literal["um", "mm", "cm", "m", "in"]
#: units of length that a model may be in
UNITS: tuple[Unit, ...] = get_args(Unit)
#: largest file of a model, or of its heavy data
MAX_BYTES = 1 << 30
SUFFIXES = (".vtu", ".xdmf", ".xmf", ".csv", ".txt")
_TO_MM: dict[str, float] = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3, "in": 25.4}
_ALSO = {"µm": "um", "μm": "um", "micron": "um", "inch": "in", "millimeter": "mm", "millimetre": "mm", "meter": "m"}
_SCALARS = (("u_mm", "v_mm", "w_mm"), ("ux", "uy", "uz"), ("u1", "u2", "u3"), ("u", "v", "w"))
_FLAT = 1e-6  # of a plane model's size: its nodes' heights may differ by rounding


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model as it was read.

    Attributes
    ----------
    mesh
        The file's content.
    displacement_mm
        (n, 3), model's frame.
    nodes_mm
        (n, 3), model's frame.
    unit, displacement_unit
        Of positions and displacements in the file.
    displacement_name
        Name of the array, or names of the arrays, that were read as the displacement.
    plane
        True of a model with two displacements: that along z is not known, and is zero here.
    """

    mesh: MeshFile
    nodes_mm: Float
    displacement_mm: Float
    unit: str
    displacement_unit: str
    displacement_name: str
    plane: bool = False

    def surface(self, towards: Float) -> ModelSurface:
        """Return the surface; a cloud of points gives the surface seen along ``towards`` (3,), model's frame.

        Raises
        ------
        InputError
            ``model_invalid``, ``model_no_surface``, ``model_not_a_surface``.
        """
        from stereorig.core.model.surface import (  # slow to load, and not every start needs it
            ModelSurface,
            surface_of_cloud,
        )

        if not self.mesh.cells:
            return replace(surface_of_cloud(self.nodes_mm, self.displacement_mm, towards), plane=self.plane)
        triangles, solid = triangles_of(self.mesh)
        surface = ModelSurface(self.nodes_mm, self.displacement_mm, triangles, closed=solid, plane=self.plane)
        return surface.facing(towards)


class ReadAs(TypedDict, total=False):
    """Choices of :func:`read_model`, as it describes them."""

    unit: Unit | None
    displacement: str | None
    time: float | None


def read_model(
    path: Path,
    *,
    unit: Unit | None = None,
    displacement: str | None = None,
    time: float | None = None,
    contents: Mapping[str, Any] | None = None,
) -> ModelFile:
    """Read a model's file: VTU, XDMF with its HDF5 file from the same folder, or a table (CSV).

    Parameters
    ----------
    path
        The file; its ending names the format.
    unit
        Unit of positions and displacements; None: the file states it.
    displacement
        Name of the nodes' displacement, or two or three names with commas between, each of a scalar or of one component
        (``U:0``, ``U_x``); None: the array whose name means a displacement. Two components are a plane model's x and y.
    time
        Time of the state to take from a series; None: the last.
    contents
        Contents of the file and contents or data sets of its companions, by name: then no file is opened.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``model_unreadable``.
    InputError
        ``model_unit_missing``, ``model_unit_conflict``, ``model_no_displacement``, ``model_displacement_unclear``,
        ``model_invalid``.
    """
    mesh = _mesh(path, time, contents, displacement)
    name, values = _displacement(mesh, displacement)
    plane = values.shape[1] == 2
    if plane:
        values = np.column_stack([values, np.zeros(len(values))])
        z = mesh.points[:, 2]
        if z.size and not np.ptp(z) <= _FLAT * np.ptp(mesh.points, axis=0).max():
            raise InputError(
                f"The model's displacement {name} has two components, but its nodes are in no plane of constant z: "
                f"{z.min():.6g} to {z.max():.6g}.",
                code="model_no_displacement",
                remedy="Export all three components, or a plane model in its plane x, y.",
            )
    own, moved = _unit(mesh, "", unit), _unit(mesh, name, unit)
    if mesh.points.size == 0:
        raise unreadable("it has no nodes")
    nodes, displaced = _TO_MM[own] * mesh.points, _TO_MM[moved] * values
    _require_sensible(nodes, "positions", 1e9)
    corners = [cells.ravel() for _, cells in mesh.cells]
    used = np.zeros(len(nodes), dtype=np.bool_) if corners else np.ones(len(nodes), dtype=np.bool_)
    used[np.concatenate(corners) if corners else []] = True
    # a node of no cell, as in the middle of a hole, may have any displacement
    _require_sensible(np.where(used[:, None], displaced, 0.0), "displacements", 1e18)
    return ModelFile(mesh, nodes, displaced, own, moved, name, plane)


def _require_sensible(values: Float, what: str, most_mm: float) -> None:
    """Refuse nodes whose positions or displacements are no length of a thing that was measured."""
    odd = np.flatnonzero(~(np.abs(values) <= most_mm).all(axis=1))  # NaN too
    if odd.size:
        raise InputError(
            f"{odd.size} of {len(values)} nodes have {what} that are not finite or beyond {most_mm:g} mm, "
            f"first node {odd[0] + 1}.",
            code="model_invalid",
            remedy="Export the measured surface with the displacement of its nodes; check the unit.",
        )


def ending_of(head: bytes) -> str:
    """Return the ending that a file without one would have, by its first bytes."""
    if b"<VTKFile" in head:
        return ".vtu"
    return ".xdmf" if b"<Xdmf" in head else ".csv"


def _mesh(path: Path, time: float | None, contents: Mapping[str, Any] | None, displacement: str | None) -> MeshFile:
    ending = path.suffix.lower()
    if ending not in SUFFIXES:
        raise unreadable(f"{path.name} ends in none of {', '.join(SUFFIXES)}")
    try:
        if (path.stat().st_size if contents is None else len(contents[path.name])) > MAX_BYTES:
            raise unreadable(f"{path.name} has more than {MAX_BYTES >> 20} MiB")
        content = checked_bytes(path) if contents is None else contents[path.name]
    except OSError as error:
        raise FileFormatError(
            f"{path.name} cannot be read: {error.strerror}.", code="file_missing", remedy="Check the path."
        ) from error
    if ending == ".vtu":
        return read_vtu(content)
    if ending in (".xdmf", ".xmf"):
        return read_xdmf(content, lambda name: _beside(path, name, contents), time=time)
    return read_table(content, displacement)


def _beside(path: Path, name: str, contents: Mapping[str, Any] | None) -> tuple[Path, Any]:
    """Return the file of heavy data, which must be in the folder of the light one."""
    plain = name.strip()
    found = path.parent / Path(plain).name
    if Path(plain).name in ("", ".", "..") or Path(plain).parent != Path():
        raise unreadable(f"it names its heavy data {plain[:100]!r}: only files in the same folder are read")
    if not (found.is_file() if contents is None else found.name in contents):
        raise unreadable(
            f"its heavy data {plain} are not in its folder", remedy=f"Give {plain} too, in the same folder or upload."
        )
    return found, None if contents is None else contents[found.name]


def _displacement(mesh: MeshFile, wanted: str | None) -> tuple[str, Float]:
    """Return name and (n, 2) or (n, 3) values of the requested displacement, or of one recognised by its name."""
    by_name = {name.lower(): name for name in mesh.data}
    if wanted is not None:
        choices = [[tuple(part.strip() for part in wanted.split(","))]]
    else:
        whole = [*((name,) for name in DISPLACEMENT if name in by_name), *_SCALARS]
        choices = [whole, [names[:2] for names in _SCALARS], [(n,) for n in by_name if is_displacement(n)]]
    for likely in choices:
        found: dict[str, Float] = {}
        for names in likely:
            held = [_column(mesh, by_name, n.lower(), whole=len(names) == 1) for n in names]
            if all(values is not None for values in held):
                values = np.column_stack([np.asarray(one, dtype=np.float64) for one in held])
                if values.shape[1] in (2, 3):
                    found[by_name.get(names[0].lower(), names[0])] = values
        first = next(iter(found), None)
        if first is not None:
            if any(not np.array_equal(one, found[first], equal_nan=True) for one in found.values()):
                raise InputError(
                    f"The model has several arrays that may be its displacement: {', '.join(found)}.",
                    code="model_displacement_unclear",
                    remedy="Name the one that is meant (--displacement, displacement).",
                )
            return first, found[first]
    shown = ", ".join(f"{n} ({1 if v.ndim == 1 else v.shape[1]})" for n, v in list(mesh.data.items())[:20]) or "none"
    asked = "no displacement" if wanted is None else f"no displacement {wanted!r}"
    raise InputError(
        f"The model has {asked} of two or three components at its nodes; it has (with components): {shown}.",
        code="model_no_displacement",
        remedy="Name the array of displacements, or its scalars as in 'ux,uy,uz' (two of a plane model); export "
        "displacements at nodes.",
    )


def _column(mesh: MeshFile, by_name: Mapping[str, str], name: str, *, whole: bool) -> Float | None:
    """Return an array (n, ...) by its name, or a scalar (n,) or component, as ``u:0`` or ``u_x``; None without."""
    if name in by_name:
        values = mesh.data[by_name[name]]
        return values if whole or values.ndim == 1 else None
    stem, part = name[:-1].rstrip(":_. "), "xyz".find(name[-1:]) if name[-1:] in "xyz" else "012".find(name[-1:])
    held = mesh.data.get(by_name.get(stem, ""))
    return held[:, part] if not whole and held is not None and held.ndim == 2 and 0 <= part < held.shape[1] else None


def _unit(mesh: MeshFile, name: str, asked: Unit | None) -> str:
    """Unit of an array: the file's own; if it states none, the user's, else the unit of the positions."""
    stated = mesh.units.get(name, "") or ("" if asked else mesh.units.get("", ""))
    what = "displacements" if name else "positions"
    if not stated:
        if asked is None:
            raise InputError(
                f"The model's file states no unit of length for its {what}.",
                code="model_unit_missing",
                remedy=f"State it: one of {', '.join(UNITS)} (--unit, unit).",
            )
        return asked
    known = _ALSO.get(stated.lower(), stated.lower())
    if known not in _TO_MM:
        raise InputError(
            f"The model's file states the unit {stated[:40]!r} for its {what}, which is no known length.",
            code="model_unit_missing",
            remedy=f"Write one of {', '.join(UNITS)} into the file.",
        )
    if asked is not None and asked != known:
        raise InputError(
            f"The model's file states {known} for its {what}, but {asked} was given.",
            code="model_unit_conflict",
            remedy="Leave the unit out where the file is right, or correct the file.",
        )
    return known
