"""Result files: one field, one NetCDF-4 file (classic model: xarray, MATLAB and ncdump all open it).

Dimensions ``row``, ``col``; points that failed hold NaN and a ``status`` with the reason. Files are written under
temporary names, so that a half-written one cannot be met. :mod:`stereorig.server.formats.results.reading` reads them
back.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import METHOD, NEIGHBOURS
from stereorig.core.status import STATUS_MEANINGS, PointStatus
from stereorig.core.strain import StrainField
from stereorig.server.formats.environment import current_environment
from stereorig.server.formats.results.layout import (
    COMPARISONS,
    COVARIANCE_NAMES,
    FORMAT_VERSION,
    FROZEN,
    PATCH_DEGREE,
    packed,
)
from stereorig.server.formats.results.netcdf import written_dataset
from stereorig.server.formats.results.parts import put, put_causes, put_cuts, put_measured, put_references, put_rejected
from stereorig.server.formats.results.strain import put_strain
from stereorig.server.formats.results.uncertainty import Included
from stereorig.server.formats.results.variables import CURVATURE, MOTION, SHAPE, VARIABLES

# measured numbers end in random bits: deflating them takes three quarters of the writing time and saves a quarter of
# the file. Repeating values are always deflated; everything is where at least this share of the points has no numbers
_MANY_EMPTY = 0.2
_FRAMES = {
    "target": "sys: X_sys, Y_sys in the calibration target's plane at its first position, Z_sys away from the cameras",
    "camera1": "sys = camera 1: X along the rows, Y down the columns, Z along the optical axis, away from the camera",
}


@dataclass(frozen=True)
class Provenance:
    """Origin of a result; written into its file.

    Parameters
    ----------
    settings
        Everything the caller chose or left at its default; goes to JSON.
    inputs
        Name of each input file and the SHA-256 of its bytes.
    software_version
        Version of this program.
    frame
        ``target`` or ``camera1``, which defines the system frame; or its description.
    step
        Number of the step, 0 = the reference.
    reference
        Number of the reference.
    extra
        Further text attributes (a label, a load).
    """

    settings: Mapping[str, object]
    inputs: Mapping[str, str]
    software_version: str
    frame: str = "target"
    step: int = 0
    reference: int = 0
    extra: Mapping[str, str] = field(default_factory=dict)


def _put_status(dataset: Any, status: NDArray[np.int8]) -> None:
    put(dataset, "status", status, ("row", "col"), units="1", long_name=VARIABLES["status"].long_name, dtype="i1")
    dataset.variables["status"].setncatts(
        {
            "flag_values": np.array([s.value for s in PointStatus], dtype=np.int8),
            "flag_meanings": " ".join(s.name.lower() for s in PointStatus),
            "comment": "; ".join(f"{s.value} = {s.name.lower()}: {STATUS_MEANINGS[s]}" for s in PointStatus),
        }
    )


def fill(dataset: Any, result: Field, provenance: Provenance, strain: StrainField | None) -> None:
    """Put a field's variables and attributes into an empty data set."""
    dataset.set_fill_off()
    rows, cols = result.shape
    sparse = float(np.mean(~result.valid)) >= _MANY_EMPTY
    for name, size in (("row", rows), ("col", cols), ("comparison", result.zncc.shape[-1])):
        dataset.createDimension(name, size)
    curved = CURVATURE if result.curvature_per_mm is not None else ()
    for v in SHAPE + (MOTION if result.has_motion else ()) + curved:
        values = None if v.values is None else v.values(result)
        assert values is not None, v.name
        smooth = result.smoothing is not None and v.group == "Displacement"
        long_name = f"{v.long_name}, smoothed" if smooth else v.long_name
        put(dataset, v.name, values, ("row", "col"), units=v.units, long_name=long_name, dtype=v.dtype, sparse=sparse)
    _put_status(dataset, result.status)
    put(
        dataset,
        "iterations",
        result.iterations,
        ("row", "col"),
        units="1",
        long_name=VARIABLES["iterations"].long_name,
        dtype="i4",
    )
    put(
        dataset,
        "zncc",
        result.zncc,
        ("row", "col", "comparison"),
        units="1",
        long_name=VARIABLES["zncc"].long_name,
        dtype="f4",
    )
    dataset.variables["zncc"].comparisons = " ".join(COMPARISONS[: result.zncc.shape[-1]])
    _put_covariance(dataset, result, sparse=sparse)
    if result.patch_degree is not None:
        put(dataset, "patch_degree", result.patch_degree, ("row", "col"), units="1", long_name=PATCH_DEGREE, dtype="i1")
    if result.rejected is not None:
        put_rejected(dataset, result.rejected)
    if result.cuts:
        put_cuts(dataset, result.cuts)
    if strain is not None:
        put_strain(dataset, strain, sparse=sparse, included=Included.of_field(result).text)
    if result.references is not None:
        put_references(dataset, result.references)
    dataset.setncatts(_attributes(provenance, moved=result.has_motion))
    if result.has_motion:
        matched = provenance.reference if result.references is None else result.references.step
        dataset.reference_step = np.int32(matched)
    if result.smoothing is not None:
        dataset.smoothing = json.dumps(result.smoothing.document(), sort_keys=True)
        if strain is not None:
            dataset.strain_note = "strain of smoothed displacements: gauge_px and gauge_mm hold the smoothing's window"
    if result.dense is not None:
        dataset.setncatts(
            {"method": METHOD, "dense": json.dumps(result.dense.document(), sort_keys=True), "neighbours": NEIGHBOURS}
        )
    if result.patch is not None:
        dataset.setncatts(
            {
                "patch": result.patch.patch,
                "patch_reason": result.patch.reason,
                "patch_choice": json.dumps(result.patch.document(), sort_keys=True),
            }
        )


def _put_covariance(dataset: Any, result: Field, *, sparse: bool) -> None:
    n = result.covariance.shape[-1]
    names = COVARIANCE_NAMES[:n]
    included = Included.of_field(result).text
    if result.has_motion:
        dataset.createDimension("entry", n * (n + 1) // 2)
    else:
        dataset.createDimension("i", n)
        dataset.createDimension("j", n)
    total = result.total_covariance
    put(
        dataset,
        "covariance",
        packed(total) if result.has_motion else total,
        ("row", "col", "entry") if result.has_motion else ("row", "col", "i", "j"),
        units="mm2",
        long_name="covariance of " + ", ".join(names),
        dtype="f4",
        sparse=sparse,
    )
    dataset.variables["covariance"].setncatts({"components": " ".join(names), "includes": included})
    if result.has_motion:
        dataset.variables["covariance"].packed = "upper triangle of the 6 x 6 matrix, row by row: " + " ".join(
            f"{a}_{b}" for k, a in enumerate(names) for b in names[k:]
        )
    if result.common is not None:
        dataset.createDimension("component", n)
        causes = Causes.unseparated(result.common.shape[-1]) if result.causes is None else result.causes
        dataset.createDimension("cause", len(causes.columns))
        put_causes(dataset, causes)
        put(
            dataset,
            "common_factor",
            result.common,
            ("row", "col", "component", "cause"),
            units="mm",
            long_name="F: what all points share of the uncertainty of " + ", ".join(names) + ", for unit causes",
            dtype="f4",
            sparse=sparse,
        )
        dataset.variables["common_factor"].setncatts(
            {
                "comment": "points a and b have the covariance F_a F_b', a point with itself covariance = own + F F'",
                "causes": " ".join(causes.separate),
            }
        )
    if result.frozen is not None:
        dataset.createDimension("frozen", len(FROZEN))
        put(
            dataset,
            "reference_covariance",
            packed(result.frozen),
            ("row", "col", "frozen"),
            units="mm2",
            long_name="part of the own covariance of u, v, w that is noise of the reference pair",
            dtype="f4",
            sparse=sparse,
        )
        dataset.variables["reference_covariance"].setncatts(
            {
                "components": " ".join(FROZEN),
                "comment": "the same in all steps of a test: a difference of two steps has the own covariances of "
                "both, less both of these, and (F_b - F_a)(F_b - F_a)'; the own covariance of x, y, z is so as a whole",
            }
        )
    sigma = result.sigma_mm
    for k, name in enumerate(names):
        put(
            dataset,
            f"sigma_{name}",
            sigma[..., k],
            ("row", "col"),
            units="mm",
            long_name=f"standard deviation of {name}",
            dtype="f4",
            sparse=sparse,
        )
        dataset.variables[f"sigma_{name}"].includes = included


def _attributes(provenance: Provenance, *, moved: bool) -> dict[str, object]:
    return {
        "Conventions": "CF-1.11",
        "title": "displacement from the reference step" if moved else "shape of the reference step",
        "kind": "displacement" if moved else "shape",
        "format_version": np.int32(FORMAT_VERSION),
        "step": np.int32(provenance.step),
        "source": f"stereorig {provenance.software_version}",
        "software_version": provenance.software_version,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "frame": _FRAMES.get(provenance.frame, provenance.frame),
        "settings": json.dumps(provenance.settings, sort_keys=True),
        "inputs_sha256": json.dumps(provenance.inputs, sort_keys=True),
        "environment": current_environment().text(),
        **provenance.extra,
    }


def write_field(
    path: str | Path,
    result: Field,
    provenance: Provenance,
    strain: StrainField | None = None,
    *,
    measured: Field | None = None,
    checksum: bool = False,
) -> None:
    """Write one result file: under a temporary name, synced, renamed.

    Parameters
    ----------
    path
        Path of the file; its folder must exist.
    result
        A shape (no ``uvw_mm``) or a displacement field.
    provenance
        Origin of the result.
    strain
        Strain of the same points, if computed; :func:`stereorig.server.formats.results.strain.read_strain` reads it
        back.
    measured
        The field before its displacement was smoothed and points were marked; later steps start from it.
    checksum
        Write the file's SHA-256 next to it, in a file ``.sha256``.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    with written_dataset(Path(path), checksum=checksum) as dataset:
        fill(dataset, result, provenance, strain)
        if measured is not None:
            put_measured(dataset, result, measured)
