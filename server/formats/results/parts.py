"""Variables of a result file, and those that only some fields have: causes, rejected values, cuts, references."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field, References, Rejected
from stereorig.core.field.region.cuts import Cuts, as_arrays
from stereorig.core.names import CAUSES
from stereorig.server.formats.results.layout import COLUMN_BY_COLUMN, ENTRIES, FROZEN, PROPAGATED_FROM, packed
from stereorig.server.formats.results.variables import VARIABLES

_REPETITIVE = ("x_px", "y_px", "status", "iterations", "zncc")


def put(
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
    """Write one variable with its units and name; deflated if its values repeat or most points have none."""
    fill = np.nan if dtype.startswith("f") else False
    pack: dict[str, Any] = {}
    if sparse or name in _REPETITIVE:
        pack = {"compression": "zlib", "complevel": 1, "shuffle": True}
    if dims[-1] == "cause":  # column by column: each is smooth over the points, and has few digits
        pack = COLUMN_BY_COLUMN | {"chunksizes": (*values.shape[:2], 1, 1)}
    variable = dataset.createVariable(name, dtype, dims, fill_value=fill, **pack)
    variable.setncatts({"units": units, "long_name": long_name})
    dataset.put(variable, values.astype(dtype, copy=False))


def put_causes(dataset: Any, causes: Causes) -> None:
    """Write the cause of each column of the common factors."""
    width = max(len(name) for name in CAUSES)  # ``sensor`` is shorter than the longest
    dataset.createDimension("cause_length", width)
    variable = dataset.createVariable("cause", "S1", ("cause", "cause_length"))
    variable.setncatts(
        {
            "long_name": "where a column's unit cause comes from; the same causes in all steps of a test",
            "units": "1",
            "_Encoding": "ascii",
        }
    )
    if causes.columns:
        dataset.put(variable, np.array(causes.columns, dtype=f"S{width}"))


def put_rejected(dataset: Any, rejected: Rejected) -> None:
    """Write the values found at points that a check rejected."""
    of_point = [("x_mm", rejected.xyz_mm[..., 0]), ("y_mm", rejected.xyz_mm[..., 1]), ("z_mm", rejected.xyz_mm[..., 2])]
    if rejected.uvw_mm is not None:
        of_point += [(f"{name}_mm", rejected.uvw_mm[..., k]) for k, name in enumerate("uvw")]
    what = "at a point that a check rejected, see its status; not checked, without uncertainty"
    for name, values in of_point:
        put(
            dataset,
            f"rejected_{name}",
            values,
            ("row", "col"),
            units="mm",
            long_name=f"{name} {what}",
            dtype="f8",
            sparse=True,
        )
    put(
        dataset,
        "rejected_epipolar_px",
        rejected.epipolar_px,
        ("row", "col"),
        units="pixel",
        long_name=f"offset across the epipolar line {what}",
        dtype="f4",
        sparse=True,
    )
    put(
        dataset,
        "rejected_zncc",
        rejected.zncc,
        ("row", "col", "comparison"),
        units="1",
        long_name=f"correlation of each comparison {what}",
        dtype="f4",
        sparse=True,
    )


def put_cuts(dataset: Any, cuts: Cuts) -> None:
    """Write the cuts, point by point."""
    points, of_line = as_arrays(cuts)
    dataset.createDimension("cut_point", len(points))
    for k, (name, along) in enumerate((("cut_x_px", "column"), ("cut_y_px", "row"))):
        put(
            dataset,
            name,
            points[:, k],
            ("cut_point",),
            units="pixel",
            long_name=f"{along} in camera 1's reference image of a point of a cut: nothing reaches over it",
            dtype="f8",
        )
    put(dataset, "cut_line", of_line, ("cut_point",), units="1", long_name="which cut the point belongs to", dtype="i4")


def put_references(dataset: Any, references: References) -> None:
    """Write the step that each point was matched against, and the errors that it took over from there."""
    put(
        dataset,
        "reference_step",
        references.steps,
        ("row", "col"),
        units="1",
        dtype="i4",
        long_name=VARIABLES["reference_step"].long_name,
        sparse=True,
    )
    for origin, cause in PROPAGATED_FROM.items():
        values = getattr(references, f"{origin}_px2")
        for name, (i, j) in ENTRIES.items():
            put(
                dataset,
                f"propagated_{origin}_{name}_px2",
                values[..., i, j],
                ("row", "col"),
                units="pixel2",
                dtype="f8",
                long_name=f"covariance by {cause} of the point's position in camera 1, propagated to later steps "
                "that are matched against this one",
            )


def put_measured(dataset: Any, result: Field, measured: Field) -> None:
    """Write the start values of later steps, if they differ from the field that is shown."""
    from stereorig.core.field.sequence.propagated import current_covariance  # slow to load

    if result.smoothing is not None and measured.uvw_mm is not None:
        for k, name in enumerate(("u", "v", "w")):
            put(
                dataset,
                f"measured_{name}_mm",
                measured.uvw_mm[..., k],
                ("row", "col"),
                units="mm",
                dtype="f8",
                long_name=f"displacement from the reference, {name.upper()}, as measured, before smoothing",
            )
    if not measured.has_motion or (result.covariance is measured.covariance and result.common is None):
        return
    if "frozen" not in dataset.dimensions:
        dataset.createDimension("frozen", len(FROZEN))
    put(
        dataset,
        "measured_current_covariance",
        packed(current_covariance(measured)),
        ("row", "col", "frozen"),
        units="mm2",
        dtype="f4",
        long_name="covariance of the current position as measured, by image noise alone: xx xy xz yy yz zz",
    )
