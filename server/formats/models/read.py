"""A model's file as a surface in millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from core.arrays import Float
from core.errors import FileFormatError, InputError
from core.model.surface import ModelSurface, surface_of_cloud
from server.formats.models.cells import triangles_of
from server.formats.models.mesh_file import MeshFile, unreadable
from server.formats.models.table import read_table
from server.formats.models.vtu import read_vtu
from server.formats.models.xdmf import read_xdmf

Unit = Literal["um", "mm", "cm", "m", "in"]
#: units of length that a model may be in
UNITS: tuple[Unit, ...] = get_args(Unit)
#: largest file of a model, or of its heavy data
MAX_BYTES = 1 << 30
SUFFIXES = (".vtu", ".xdmf", ".xmf", ".csv", ".txt")
_TO_MM: dict[str, float] = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3, "in": 25.4}
_ALSO = {"µm": "um", "μm": "um", "micron": "um", "inch": "in", "millimeter": "mm", "millimetre": "mm", "meter": "m"}
_DISPLACEMENT = ("displacement", "displacements", "u", "disp", "depl", "displ")
_SCALARS = (("u_mm", "v_mm", "w_mm"), ("ux", "uy", "uz"), ("u1", "u2", "u3"), ("u", "v", "w"))


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model as it was read.

    Attributes
    ----------
    mesh
        What the file holds.
    displacement_mm
        (n, 3).
    nodes_mm
        (n, 3).
    unit, displacement_unit
        Of positions and displacements in the file.
    displacement_name
        Of the array or arrays that were taken.
    """

    mesh: MeshFile
    nodes_mm: Float
    displacement_mm: Float
    unit: str
    displacement_unit: str
    displacement_name: str

    def surface(self, towards: Float) -> ModelSurface:
        """Return the surface; that of a cloud of points as it is seen along ``towards`` (3,), model's frame.

        Raises
        ------
        InputError
            ``model_invalid``, ``model_no_surface``, ``model_not_a_surface``.
        """
        if not self.mesh.cells:
            return surface_of_cloud(self.nodes_mm, self.displacement_mm, towards)
        triangles, solid = triangles_of(self.mesh)
        surface = ModelSurface(self.nodes_mm, self.displacement_mm, triangles, closed=solid)
        return surface.facing(towards)


def read_model(
    path: Path, *, unit: Unit | None = None, displacement: str | None = None, time: float | None = None
) -> ModelFile:
    """Read a model's file: VTU, XDMF with its HDF5 beside it, or a table (CSV).

    Parameters
    ----------
    path
        Of the file; its ending names the format.
    unit
        Of length, positions and displacements; None: the file states it.
    displacement
        Name of the nodes' displacement, or three names parted by commas; None: the one whose name says so.
    time
        Of the state to take from a series; None: the last.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``model_unreadable``.
    InputError
        ``model_unit_missing``, ``model_unit_conflict``, ``model_no_displacement``.
    """
    mesh = _mesh(path, time)
    name, values = _displacement(mesh, displacement)
    own, moved = _unit(mesh, "", unit), _unit(mesh, name, unit)
    if mesh.points.size == 0:
        raise unreadable("it has no nodes")
    return ModelFile(mesh, _TO_MM[own] * mesh.points, _TO_MM[moved] * values, own, moved, name)


def ending_of(head: bytes) -> str:
    """Return the ending that a file without one would have, by its first bytes."""
    if b"<VTKFile" in head:
        return ".vtu"
    return ".xdmf" if b"<Xdmf" in head else ".csv"


def _mesh(path: Path, time: float | None) -> MeshFile:
    ending = path.suffix.lower()
    if ending not in SUFFIXES:
        raise unreadable(f"{path.name} ends in none of {', '.join(SUFFIXES)}")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise unreadable(f"{path.name} has more than {MAX_BYTES >> 20} MiB")
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(
            f"{path} cannot be read: {error.strerror}.", code="file_missing", remedy="Check the path."
        ) from error
    if ending == ".vtu":
        return read_vtu(content)
    if ending in (".xdmf", ".xmf"):
        return read_xdmf(content, lambda name: _beside(path, name), time=time)
    return read_table(content)


def _beside(path: Path, name: str) -> Path:
    """Return the file of heavy data, which lies beside the light one and nowhere else."""
    plain = name.strip()
    found = path.parent / Path(plain).name
    if Path(plain).name in ("", ".", "..") or Path(plain).parent != Path():
        raise unreadable(f"it names its heavy data {plain[:100]!r}: only files beside it are read")
    if not found.is_file():
        raise unreadable(
            f"its heavy data {plain} are not beside it", remedy=f"Give {plain} too, in the same folder or upload."
        )
    return found


def _displacement(mesh: MeshFile, wanted: str | None) -> tuple[str, Float]:
    by_name = {name.lower(): name for name in mesh.data}
    if wanted is not None:
        choices = [tuple(part.strip() for part in wanted.split(","))]
    else:
        choices = [(name,) for name in _DISPLACEMENT] + list(_SCALARS)
    for names in choices:
        held = [mesh.data[by_name[n.lower()]] for n in names if n.lower() in by_name]
        if len(held) != len(names):
            continue
        values = held[0] if len(held) == 1 else np.column_stack(held)
        if values.ndim == 2 and values.shape[1] == 3:
            return by_name[names[0].lower()], np.asarray(values, dtype=np.float64)
    shown = ", ".join(f"{n} ({1 if v.ndim == 1 else v.shape[1]})" for n, v in list(mesh.data.items())[:20]) or "none"
    asked = (
        "no displacement of three components" if wanted is None else f"no displacement {wanted!r} of three components"
    )
    raise InputError(
        f"The model has {asked} at its nodes; it has (with components): {shown}.",
        code="model_no_displacement",
        remedy="Name the array of displacements, or three scalars as in 'ux,uy,uz'; export displacements at nodes.",
    )


def _unit(mesh: MeshFile, name: str, asked: Unit | None) -> str:
    """Unit of an array: the file's own; for one without, the user's, else that of the positions."""
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
