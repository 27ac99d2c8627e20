"""Strain in a result file: its variables and options."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.errors import FileFormatError
from stereorig.core.strain import STRAIN_STATUS_MEANINGS, StrainField, StrainOptions, StrainStatus
from stereorig.server.formats.results.layout import COLUMN_BY_COLUMN
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.formats.results.variables import PATCH, SIGMA, STRAIN, STRAIN_NAMES, VARIABLES, described

_TENSOR = {
    "green_lagrange": "Green-Lagrange strain",
    "infinitesimal": "infinitesimal strain",
    "hencky": "Hencky (logarithmic) strain",
}
_AXES = (
    "axis 1 is X_sys projected on the reference surface, axis 2 completes it with the normal that points away from "
    "camera 1; shear is the tensor's, half the engineering shear"
)


def put_strain(dataset: Any, strain: StrainField, *, included: str, sparse: bool = False) -> None:
    """Add the strain's variables (``row``, ``col``) to an open result file; strain as a pure number.

    ``included`` states the terms that its uncertainties include.
    """
    tensor = _TENSOR[strain.options.tensor]
    about = {"gauge_px": strain.gauge_px, "gauge_mm": strain.gauge_mm, "window_points": np.int32(strain.options.window)}
    for one in STRAIN:
        for name, read in ((one.name, one.values), (SIGMA + one.name, one.sigma)):
            if read is not None:
                long_name = described(name).long_name.format(tensor=tensor)
                variable = _variable(dataset, name, read(strain), one.units, long_name, sparse=sparse)
                variable.setncatts(about)
                if name.startswith(SIGMA):
                    variable.includes = included
    if strain.patch is not None:
        for k, one in enumerate(STRAIN[: len(STRAIN_NAMES)]):
            long_name = one.long_name.format(tensor=f"{tensor} of the patch itself")
            variable = _variable(dataset, one.name + PATCH, strain.patch[..., k], one.units, long_name, sparse=sparse)
            variable.setncatts({"gauge_px": float(strain.subset_px)})
    total = strain.total_covariance
    _variable(dataset, "strain_covariance_exx_eyy", total[..., 0, 1], "1", "covariance of exx and eyy", sparse=sparse)
    for k, name in enumerate(("exx", "eyy")):
        _variable(
            dataset,
            f"strain_covariance_{name}_exy",
            total[..., k, 2],
            "1",
            f"covariance of {name} and exy",
            sparse=sparse,
        )
    if strain.common is not None:
        dataset.createDimension("strain_component", len(STRAIN_NAMES))
        common = dataset.createVariable(
            "common_factor_strain",
            "f4",
            ("row", "col", "strain_component", "cause"),
            fill_value=np.nan,
            chunksizes=(*strain.common.shape[:2], 1, 1),
            **COLUMN_BY_COLUMN,
        )
        names = ", ".join(STRAIN_NAMES)
        common.setncatts({"units": "1", "long_name": f"F: what all points share of the uncertainty of {names}"})
        dataset.put(common, strain.common.astype(np.float32, copy=False))
    status = dataset.createVariable(
        "strain_status", "i1", ("row", "col"), fill_value=False, compression="zlib", complevel=1
    )
    status.setncatts(
        {
            "units": "1",
            "long_name": VARIABLES["strain_status"].long_name,
            "flag_values": np.array([s.value for s in StrainStatus], dtype=np.int8),
            "flag_meanings": " ".join(s.name.lower() for s in StrainStatus),
            "comment": "; ".join(f"{s.value} = {s.name.lower()}: {STRAIN_STATUS_MEANINGS[s]}" for s in StrainStatus),
        }
    )
    dataset.put(status, strain.status)
    document = {
        **asdict(strain.options),
        "spacing_px": strain.spacing_px,
        "subset_px": strain.subset_px,
        "gauge_px": strain.gauge_px,
        "gauge_mm": None if np.isnan(strain.gauge_mm) else strain.gauge_mm,
    }
    dataset.setncatts({"strain": json.dumps(document, sort_keys=True), "strain_axes": _AXES})


def _variable(dataset: Any, name: str, values: Any, units: str, long_name: str, *, sparse: bool) -> Any:
    pack = {"compression": "zlib", "complevel": 1, "shuffle": True} if sparse else {}
    variable = dataset.createVariable(name, "f4", ("row", "col"), fill_value=np.nan, **pack)
    variable.setncatts({"units": units, "long_name": long_name})
    dataset.put(variable, np.asarray(values, dtype=np.float32))
    return variable


def read_strain(path: str | Path) -> StrainField | None:
    """Read the strain back from a result file; None if it holds none.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``.
    """
    path = Path(path)
    try:
        with opened(path) as dataset:
            return _strain_of(dataset)
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path} does not hold strain as this program writes it: {error}.") from error


def _strain_of(dataset: Any) -> StrainField | None:
    if "strain" not in dataset.ncattrs():
        return None
    document = json.loads(dataset.strain)
    variables = dataset.variables

    def stacked(suffix: str = "", prefix: str = "") -> Any:
        return np.stack(
            [np.asarray(variables[f"{prefix}{n}{suffix}"][...], dtype=np.float64) for n in STRAIN_NAMES], axis=-1
        )

    strain, sigma = stacked(), stacked(prefix="sigma_")
    covariance = np.zeros((*strain.shape, 3))
    covariance[..., range(3), range(3)] = sigma**2
    for name, i, j in (
        ("strain_covariance_exx_eyy", 0, 1),
        ("strain_covariance_exx_exy", 0, 2),
        ("strain_covariance_eyy_exy", 1, 2),
    ):
        covariance[..., i, j] = covariance[..., j, i] = variables[name][...]
    common = None
    if "common_factor_strain" in variables:
        common = np.asarray(variables["common_factor_strain"][...], dtype=np.float64)
        covariance = covariance - common @ np.swapaxes(common, -1, -2)
    known = StrainOptions.__dataclass_fields__
    return StrainField(
        options=StrainOptions(**{k: v for k, v in document.items() if k in known}),
        spacing_px=document["spacing_px"],
        subset_px=document["subset_px"],
        gauge_px=document["gauge_px"],
        gauge_mm=np.nan if document["gauge_mm"] is None else document["gauge_mm"],
        status=np.asarray(variables["strain_status"][...], dtype=np.int8),
        strain=strain,
        covariance=covariance,
        patch=stacked("_patch") if "exx_patch" in variables else None,
        common=common,
    )
