"""Steps as VTK unstructured grids, and the PVD file that makes a time series of them."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.region.triangles import triangles_of, turned_as
from stereorig.server.formats.files import write_bytes, written_temporary
from stereorig.server.results.provenance import provenance
from stereorig.server.results.reader import FileVariable
from stereorig.server.results.steps import ExportSource, StepResult, columns_of, statement_of
from stereorig.server.results.uncertainty import matrix_columns

NEEDS = ("x_px", "y_px", "x_mm", "y_mm", "z_mm", "status", "u_mm", "v_mm", "w_mm", "normal_x", "normal_y", "normal_z")
_VECTORS = {"displacement": ("u_mm", "v_mm", "w_mm"), "normal": ("normal_x", "normal_y", "normal_z")}
_POSITIONS = ("x_mm", "y_mm", "z_mm")
_TRIANGLE, _VERTEX = 5, 1
_TYPES = {"f8": "Float64", "f4": "Float32", "i8": "Int64", "i4": "Int32", "i2": "Int16", "i1": "Int8", "u1": "UInt8"}


def write_vtu(
    path: Path,
    step: StepResult,
    source: ExportSource,
    *,
    mask: NDArray[np.bool_] | None = None,
    at_rest: bool = False,
    time: float | None = None,
) -> None:
    """Write one step: points where the surface was at the reference, triangles between neighbours, all variables.

    Parameters
    ----------
    path
        The file.
    step
        With the variables of :data:`NEEDS` that it has.
    source
        Its provenance.
    mask
        Camera 1's image, False at pixels that no triangle may cover.
    time
        Time of the step in the time series; None: its number.
    at_rest
        Displacements are relative to this step: its own is zero, which a time series needs to warp all its steps.

    Notes
    -----
    Points that failed are not in the file. ``displacement`` and ``normal`` are vectors; warping by ``displacement``
    gives the surface as it is at the step. A point of no triangle is written as a vertex. Triangles turn so that their
    normals point as ``normal`` does. Units, frame and settings are JSON in a comment at the top, and in the field data
    (``provenance_json_utf8``, its bytes), the included uncertainties in ``uncertainty_utf8``; arrays carry VTK's
    UNITS_LABEL. ``covariance`` has the entries of its upper triangle as components, ``common_factor`` its own.
    """
    columns = columns_of(step)
    keep = np.flatnonzero(step.valid.ravel())
    xyz = np.stack([columns[n].values.ravel() for n in _POSITIONS], axis=1)
    triangles = triangles_of(columns["x_px"].values, columns["y_px"].values, step.valid, step.cuts, mask)
    normals = _vector(columns, _VECTORS["normal"])
    if normals is not None:
        triangles = turned_as(triangles, xyz, normals)
    index = np.full(xyz.shape[0], -1, dtype=np.int64)
    index[keep] = np.arange(keep.size)
    alone = np.setdiff1d(np.arange(keep.size), index[triangles], assume_unique=False)
    cells = np.concatenate([index[triangles].ravel(), alone])
    offsets = np.concatenate([3 * np.arange(1, len(triangles) + 1), 3 * len(triangles) + np.arange(1, alone.size + 1)])
    kinds = np.concatenate([np.full(len(triangles), _TRIANGLE), np.full(alone.size, _VERTEX)]).astype(np.uint8)
    with written_temporary(path) as temporary, temporary.open("w", encoding="utf-8") as out:
        about = _about(step, source, columns)
        out.write(
            f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {about} -->\n<VTKFile type="UnstructuredGrid" '
            'version="1.0" byte_order="LittleEndian" header_type="UInt64">\n<UnstructuredGrid>\n'
            "<FieldData>\n"
        )
        _field_data(out, step, source, about, float(step.n) if time is None else time)
        out.write(f'</FieldData>\n<Piece NumberOfPoints="{keep.size}" NumberOfCells="{kinds.size}">\n<Points>\n')
        _array(out, "Points", xyz[keep], units="mm")
        out.write("</Points>\n<Cells>\n")
        for name, values in (("connectivity", cells), ("offsets", offsets), ("types", kinds)):
            _array(out, name, values if name == "types" else values.astype(np.int64))
        active = "displacement" if "u_mm" in columns or at_rest else "normal"
        out.write(f'</Cells>\n<PointData Vectors="{active}" Scalars="{"w_mm" if "w_mm" in columns else "z_mm"}">\n')
        for name, parts in _VECTORS.items():
            vector = np.zeros_like(xyz) if at_rest and name == "displacement" else _vector(columns, parts)
            if vector is not None:
                _array(out, name, vector[keep], units="mm" if name == "displacement" else "1")
        for k, name in enumerate(("row", "col")):
            _array(out, name, np.unravel_index(keep, step.shape)[k].astype(np.int32))
        for name, variable in columns.items():
            _array(out, name, variable.values.ravel()[keep], units=variable.units)
        for name, variable in step.variables.items():
            entries = matrix_columns(name, variable)
            if entries:
                matrix = np.stack([one.values.ravel()[keep] for one in entries.values()], axis=1)
                named = [one.removeprefix(f"{name}_") for one in entries]
                _array(out, name, matrix, units=variable.units, components=named)
        out.write("</PointData>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n")


def write_pvd(path: Path, files: Iterable[tuple[float, str]]) -> None:
    """Write the time series: time of each step, in seconds since the reference or its number, and the file's name."""
    lines = [f'<DataSet timestep="{n:.12g}" group="" part="0" file={quoteattr(name)}/>' for n, name in files]
    text = [
        '<?xml version="1.0" encoding="utf-8"?>',
        '<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">',
        "<Collection>",
        *lines,
        "</Collection>",
        "</VTKFile>",
        "",
    ]
    write_bytes(path, "\n".join(text).encode())


def _vector(columns: dict[str, FileVariable], parts: tuple[str, ...]) -> NDArray[np.float64] | None:
    if not all(name in columns for name in parts):
        return None
    return np.stack([columns[name].values.ravel().astype(np.float64) for name in parts], axis=1)


def _field_data(out: TextIO, step: StepResult, source: ExportSource, about: str, time: float) -> None:
    _array(out, "TimeValue", np.array([time]), tuples=1)
    for name, value in step.recorded.channels.items():
        _array(out, name, np.array([value]), tuples=1, units=step.recorded.units[name])
    for name, u in step.recorded.u.items():
        _array(out, f"{name}_u", np.array([u]), tuples=1, units=step.recorded.units[name])
    if step.load_n is not None:
        _array(out, "load_n", np.array([step.load_n]), tuples=1)
    # as bytes: readers other than VTK's own do not take its arrays of text
    text = np.frombuffer(about.encode(), dtype=np.uint8)
    _array(out, "provenance_json_utf8", text, tuples=text.size)
    said = np.frombuffer(statement_of(step, source).text.encode(), dtype=np.uint8)
    _array(out, "uncertainty_utf8", said, tuples=said.size)


def _about(step: StepResult, source: ExportSource, columns: dict[str, FileVariable]) -> str:
    units = {name: v.units for name, v in columns.items()} | {"displacement": "mm", "normal": "1", "Points": "mm"}
    states = {name: {str(k): t for k, t in v.flags.items()} for name, v in columns.items() if v.flags is not None}
    document = {**provenance(step, source), "units": units, "states": states}
    # an XML comment must not hold two hyphens
    return json.dumps(document, sort_keys=True).replace("--", "-\\u002d")


def _array(
    out: TextIO,
    name: str,
    values: NDArray[Any],
    *,
    tuples: int | None = None,
    units: str | None = None,
    components: Sequence[str] = (),
) -> None:
    kind = _TYPES[values.dtype.str[1:]]
    parts = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    parts += "".join(f" ComponentName{k}={quoteattr(one)}" for k, one in enumerate(components))
    size = "" if tuples is None else f' NumberOfTuples="{tuples}"'
    data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
    text = base64.b64encode(np.uint64(len(data)).tobytes() + data).decode("ascii")
    out.write(f'<DataArray type="{kind}" Name={quoteattr(name)}{parts}{size} format="binary">{text}')
    if units is not None:
        out.write(f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{escape(units)}</InformationKey>')
    out.write("</DataArray>\n")
