"""Result files: one field, one NetCDF-4 file (classic model: xarray, MATLAB and ncdump all open it).

Dimensions ``row``, ``col``; points that failed hold NaN and a ``status`` that says why. Files are written aside, so
that a half-written one cannot be met.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import netCDF4
import numpy as np
from numpy.typing import NDArray

from core.errors import FileFormatError
from core.field.cuts import Cuts, as_arrays, from_arrays
from core.field.patch import PatchChoice
from core.field.result import Field
from core.status import STATUS_MEANINGS, PointStatus
from core.strain import StrainField
from server.io.files import written_aside
from server.io.strain_netcdf import put_strain

FORMAT_VERSION = 1
_NEARLY_FULL_BYTES = 1 << 20
# measured numbers end in random bits: deflating them takes three quarters of the writing time and saves a quarter of
# the file. What repeats is always deflated; everything is where at least this share of the points has no numbers
_MANY_EMPTY = 0.2
_REPETITIVE = ("x_px", "y_px", "status", "iterations", "zncc")
COMPARISONS = ("cam1_t0__cam2_t0", "cam1_t0__cam1_t", "cam1_t0__cam2_t")
COVARIANCE_NAMES = ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")
_FRAMES = {
    "target": "sys: X_sys, Y_sys in the calibration target's plane at its first position, Z_sys away from the cameras",
    "camera1": "sys = camera 1: X along the rows, Y down the columns, Z along the optical axis, away from the camera",
}


class _Variable(NamedTuple):
    """One two-dimensional variable: where it stands in a Field, and how it is described."""

    name: str
    attribute: str
    component: int | None
    units: str
    long_name: str
    dtype: str = "f8"


_SHAPE = (
    _Variable("x_px", "x_px", None, "pixel", "column of the point in camera 1's reference image"),
    _Variable("y_px", "y_px", None, "pixel", "row of the point in camera 1's reference image"),
    _Variable("x_mm", "xyz_mm", 0, "mm", "reference position of the material point, X_sys"),
    _Variable("y_mm", "xyz_mm", 1, "mm", "reference position of the material point, Y_sys"),
    _Variable("z_mm", "xyz_mm", 2, "mm", "reference position of the material point, Z_sys"),
    _Variable("normal_x", "normal_sys", 0, "1", "surface normal, X_sys component"),
    _Variable("normal_y", "normal_sys", 1, "1", "surface normal, Y_sys component"),
    _Variable("normal_z", "normal_sys", 2, "1", "surface normal, Z_sys component"),
    _Variable("theta_rad", "theta_rad", None, "rad", "angle of the patch's normal to X_cam1, Eq. (12)"),
    _Variable("phi_rad", "phi_rad", None, "rad", "angle of the patch's normal to Y_cam1, Eq. (12)"),
    _Variable("zp_mm", "zp_mm", None, "mm", "where camera 1's axis meets the patch's plane, Eq. (12)"),
    _Variable(
        "epipolar_px",
        "epipolar_px",
        None,
        "pixel",
        "full offset across the epipolar line in camera 2; half of it is left in each image when both share it",
        "f4",
    ),
    _Variable("noise_grey", "noise_grey", None, "count", "noise of the reference image, from the residuals", "f4"),
)
_MOTION = (
    _Variable("u_mm", "uvw_mm", 0, "mm", "displacement from the reference, X_sys component"),
    _Variable("v_mm", "uvw_mm", 1, "mm", "displacement from the reference, Y_sys component"),
    _Variable("w_mm", "uvw_mm", 2, "mm", "displacement from the reference, Z_sys component"),
    _Variable("rotation_x_rad", "rotation_rad", 0, "rad", "rotation vector of the patch, X_sys component"),
    _Variable("rotation_y_rad", "rotation_rad", 1, "rad", "rotation vector of the patch, Y_sys component"),
    _Variable("rotation_z_rad", "rotation_rad", 2, "rad", "rotation vector of the patch, Z_sys component"),
    _Variable("stretch_11", "stretch", 0, "1", "in-plane stretch of the patch, e11 in its tangent frame"),
    _Variable("stretch_22", "stretch", 1, "1", "in-plane stretch of the patch, e22 in its tangent frame"),
    _Variable("stretch_12", "stretch", 2, "1", "in-plane stretch of the patch, e12 in its tangent frame"),
)
_CURVATURE = (
    _Variable("curvature_1", "curvature_per_mm", 0, "mm-1",
              "larger principal curvature of the reference's surface, positive where it bulges towards the cameras"),
    _Variable("curvature_2", "curvature_per_mm", 1, "mm-1",
              "smaller principal curvature of the reference's surface, positive where it bulges towards the cameras"),
)  # fmt: skip


@dataclass(frozen=True)
class Provenance:
    """Where a result comes from; written into its file.

    Parameters
    ----------
    settings
        Everything the caller chose or left at its default; goes to JSON.
    inputs
        Name of each input file and the SHA-256 of its bytes.
    software_version
        Of this program.
    frame
        ``target`` or ``camera1``: what the system frame is.
    step
        Number of the step, 0 = the reference.
    extra
        Further text attributes (a label, a load).
    """

    settings: Mapping[str, Any]
    inputs: Mapping[str, str]
    software_version: str
    frame: str = "target"
    step: int = 0
    extra: Mapping[str, str] = field(default_factory=dict)


def _put(
    dataset: Any,
    name: str,
    values: NDArray[Any],
    dims: tuple[str, ...],
    *,
    units: str,
    long_name: str,
    dtype: str,
    sparse: bool = False,
) -> None:
    fill = np.nan if dtype.startswith("f") else False
    pack = {"compression": "zlib", "complevel": 1, "shuffle": True} if sparse or name in _REPETITIVE else {}
    variable = dataset.createVariable(name, dtype, dims, fill_value=fill, **pack)
    variable.setncatts({"units": units, "long_name": long_name})
    variable[...] = values


def _put_status(dataset: Any, status: NDArray[np.int8]) -> None:
    _put(dataset, "status", status, ("row", "col"), units="1", long_name="what can be said about the point", dtype="i1")
    dataset.variables["status"].setncatts(
        {
            "flag_values": np.array([s.value for s in PointStatus], dtype=np.int8),
            "flag_meanings": " ".join(s.name.lower() for s in PointStatus),
            "comment": "; ".join(f"{s.value} = {s.name.lower()}: {STATUS_MEANINGS[s]}" for s in PointStatus),
        }
    )


def _fill(dataset: Any, result: Field, provenance: Provenance, strain: StrainField | None) -> None:
    dataset.set_fill_off()
    rows, cols = result.shape
    sparse = float(np.mean(~result.valid)) >= _MANY_EMPTY
    for name, size in (("row", rows), ("col", cols), ("comparison", result.zncc.shape[-1])):
        dataset.createDimension(name, size)
    curved = _CURVATURE if result.curvature_per_mm is not None else ()
    for v in _SHAPE + (_MOTION if result.has_motion else ()) + curved:
        values = getattr(result, v.attribute)
        if v.component is not None:
            values = values[..., v.component]
        _put(dataset, v.name, values, ("row", "col"), units=v.units, long_name=v.long_name, dtype=v.dtype,
             sparse=sparse)  # fmt: skip
    _put_status(dataset, result.status)
    _put(dataset, "iterations", result.iterations, ("row", "col"), units="1",
         long_name="iterations of the fit", dtype="i4")  # fmt: skip
    _put(dataset, "zncc", result.zncc, ("row", "col", "comparison"), units="1",
         long_name="zero-mean normalised correlation of each comparison", dtype="f4")  # fmt: skip
    dataset.variables["zncc"].comparisons = " ".join(COMPARISONS[: result.zncc.shape[-1]])
    _put_covariance(dataset, result, sparse=sparse)
    if result.cuts:
        _put_cuts(dataset, result.cuts)
    if strain is not None:
        put_strain(dataset, strain, sparse=sparse)
    dataset.setncatts(_attributes(provenance, moved=result.has_motion))
    if result.patch is not None:
        dataset.setncatts({
            "patch": result.patch.patch,
            "patch_reason": result.patch.reason,
            "patch_choice": json.dumps(result.patch.document(), sort_keys=True),
        })  # fmt: skip


def _put_covariance(dataset: Any, result: Field, *, sparse: bool) -> None:
    n = result.covariance.shape[-1]
    names = COVARIANCE_NAMES[:n]
    dataset.createDimension("i", n)
    dataset.createDimension("j", n)
    _put(dataset, "covariance", result.covariance, ("row", "col", "i", "j"), units="mm2",
         long_name="covariance of " + ", ".join(names), dtype="f4", sparse=sparse)  # fmt: skip
    dataset.variables["covariance"].components = " ".join(names)
    sigma = result.sigma_mm
    for k, name in enumerate(names):
        _put(dataset, f"sigma_{name}", sigma[..., k], ("row", "col"), units="mm",
             long_name=f"standard deviation of {name}", dtype="f4", sparse=sparse)  # fmt: skip


def _put_cuts(dataset: Any, cuts: Cuts) -> None:
    points, of_line = as_arrays(cuts)
    dataset.createDimension("cut_point", len(points))
    for k, (name, along) in enumerate((("cut_x_px", "column"), ("cut_y_px", "row"))):
        _put(dataset, name, points[:, k], ("cut_point",), units="pixel",
             long_name=f"{along} in camera 1's reference image of a point of a cut: nothing reaches over it",
             dtype="f8")  # fmt: skip
    _put(dataset, "cut_line", of_line, ("cut_point",), units="1", long_name="which cut the point belongs to",
         dtype="i4")  # fmt: skip


def _cuts_of(variables: Any) -> Cuts | None:
    if "cut_line" not in variables:
        return None
    points = np.stack([np.asarray(variables[name][...], dtype=np.float64) for name in ("cut_x_px", "cut_y_px")], axis=1)
    return from_arrays(points, np.asarray(variables["cut_line"][...], dtype=np.int32))


def _attributes(provenance: Provenance, *, moved: bool) -> dict[str, Any]:
    return {
        "Conventions": "CF-1.11",
        "title": "displacement from the reference step" if moved else "shape of the reference step",
        "kind": "displacement" if moved else "shape",
        "format_version": np.int32(FORMAT_VERSION),
        "step": np.int32(provenance.step),
        "source": f"stereorig {provenance.software_version}",
        "software_version": provenance.software_version,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "frame": _FRAMES[provenance.frame],
        "settings": json.dumps(provenance.settings, sort_keys=True),
        "inputs_sha256": json.dumps(provenance.inputs, sort_keys=True),
        **provenance.extra,
    }


def write_field(path: str | Path, result: Field, provenance: Provenance, strain: StrainField | None = None) -> None:
    """Write one result file: aside, synced, renamed.

    Parameters
    ----------
    path
        Of the file; its folder must exist.
    result
        A shape (no ``uvw_mm``) or a displacement field.
    provenance
        What it was made from and how.
    strain
        Of the same points, if it was computed; :func:`server.io.strain_netcdf.read_strain` reads it back.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    with written_aside(Path(path)) as aside:
        try:
            with netCDF4.Dataset(str(aside), "w", format="NETCDF4_CLASSIC") as dataset:
                _fill(dataset, result, provenance, strain)
        except RuntimeError as error:  # the HDF5 library's failed writes come without an errno
            full = shutil.disk_usage(aside.parent).free < _NEARLY_FULL_BYTES
            raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from error


def _open(path: Path) -> Any:
    if not path.exists():
        raise FileFormatError(f"The result file {path} does not exist.", code="file_missing", remedy="Check the path.")
    try:
        dataset = netCDF4.Dataset(str(path), "r")
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read as a result file: {error.strerror or error}.") from error
    version = int(getattr(dataset, "format_version", 0))
    if not 1 <= version <= FORMAT_VERSION:
        dataset.close()
        raise FileFormatError(
            f"{path} has the result format {version or 'none'}; this program reads up to {FORMAT_VERSION}.",
            code="format_too_new" if version else "file_unreadable",
            remedy="Read it with the program's version that wrote it.",
        )
    dataset.set_auto_mask(False)
    return dataset


def read_field(path: str | Path) -> Field:
    """Read one result file back.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable`` (not such a file, a variable missing) or ``format_too_new``.
    """
    path = Path(path)
    with _open(path) as dataset:
        variables = dataset.variables
        shape = (dataset.dimensions["row"].size, dataset.dimensions["col"].size)
        curved = _CURVATURE if _CURVATURE[0].name in variables else ()
        wanted = _SHAPE + (_MOTION if dataset.kind == "displacement" else ()) + curved
        names = [v.name for v in wanted] + ["status", "iterations", "zncc", "covariance"]
        missing = [name for name in names if name not in variables]
        if missing:
            raise FileFormatError(f"{path} lacks the variables {', '.join(missing)}.")
        arrays: dict[str, Any] = {}
        for v in wanted:
            values = np.asarray(variables[v.name][...], dtype=np.float64)
            if v.component is None:
                arrays[v.attribute] = values
            else:
                tail = 2 if v in _CURVATURE else 3
                arrays.setdefault(v.attribute, np.full((*shape, tail), np.nan))[..., v.component] = values
        choice = getattr(dataset, "patch_choice", None)
        return Field(
            **arrays,
            status=np.asarray(variables["status"][...], dtype=np.int8),
            iterations=np.asarray(variables["iterations"][...], dtype=np.int32),
            zncc=np.asarray(variables["zncc"][...], dtype=np.float64),
            covariance=np.asarray(variables["covariance"][...], dtype=np.float64),
            patch=None if choice is None else PatchChoice.from_document(json.loads(choice)),
            cuts=_cuts_of(variables),
        )


def read_attributes(path: str | Path) -> dict[str, Any]:
    """Read a result file's global attributes; ``settings``, ``inputs_sha256``, ``patch_choice`` come back as objects.

    Raises
    ------
    FileFormatError
        As :func:`read_field`.
    """
    with _open(Path(path)) as dataset:
        attributes = {name: dataset.getncattr(name) for name in dataset.ncattrs()}
    for name in ("settings", "inputs_sha256", "patch_choice"):
        if name in attributes:
            attributes[name] = json.loads(attributes[name])
    return attributes


def field_variable(result: Field, name: str) -> tuple[NDArray[np.float64], str, str] | None:
    """Return values (r, c), unit and meaning of a variable as a result file would hold it; None for others."""
    for v in _SHAPE + _MOTION + _CURVATURE:
        values = getattr(result, v.attribute) if v.name == name else None
        if values is not None:
            return values if v.component is None else values[..., v.component], v.units, v.long_name
    return None
