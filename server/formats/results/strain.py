"""Strain in a result file: its variables and options."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from core.errors import FileFormatError
from core.strain import STRAIN_STATUS_MEANINGS, StrainField, StrainOptions, StrainStatus
from server.formats.results.layout import COLUMN_BY_COLUMN
from server.formats.results.netcdf import opened
from server.formats.results.settings import current_entries

_TENSOR = {
    "green_lagrange": "Green-Lagrange strain",
    "infinitesimal": "infinitesimal strain",
    "hencky": "Hencky (logarithmic) strain",
}
_AXES = (
    "axis 1 is X_sys projected on the reference surface, axis 2 completes it with the normal that points away from "
    "camera 1; shear is the tensor's, half the engineering shear"
)
_COMPONENTS = (("exx", "along axis 1"), ("eyy", "along axis 2"), ("exy", "shear of the tensor"))


def put_strain(dataset: Any, strain: StrainField, *, included: str, sparse: bool = False) -> None:
    """Add the strain's variables (``row``, ``col``) to an open result file; strain as a pure number.

    ``included`` says what its uncertainties include.
    """
    tensor = _TENSOR[strain.options.tensor]
    principal, sigma, sigma_principal = strain.principal, strain.sigma, strain.sigma_principal
    found: list[tuple[str, Any, str, str]] = []
    for k, (name, component) in enumerate(_COMPONENTS):
        found.append((name, strain.strain[..., k], "1", f"{tensor}, {component}"))
        found.append((f"sigma_{name}", sigma[..., k], "1", f"standard deviation of {name}"))
    for k, which in enumerate(("larger", "smaller")):
        found.append((f"e{k + 1}", principal[..., k], "1", f"{tensor}, {which} principal value"))
        found.append((f"sigma_e{k + 1}", sigma_principal[..., k], "1", f"standard deviation of e{k + 1}, linearised"))
    found += [
        ("strain_angle_rad", strain.angle_rad, "rad", "direction of e1 from axis 1 towards axis 2"),
        ("max_shear", strain.max_shear, "1", "largest in-plane shear of the tensor, (e1 - e2) / 2"),
        ("von_mises", strain.von_mises, "1", "equivalent strain, sqrt(e1^2 - e1 e2 + e2^2)"),
    ]
    for name, values, units, long_name in found:
        about = {"gauge_px": strain.gauge_px, "gauge_mm": strain.gauge_mm}
        variable = _variable(dataset, name, values, units, long_name, sparse=sparse)
        variable.setncatts(about | {"window_points": np.int32(strain.options.window)})
        if name.startswith("sigma_"):
            variable.includes = included
    if strain.patch is not None:
        for k, (name, component) in enumerate(_COMPONENTS):
            _variable(
                dataset,
                f"{name}_patch",
                strain.patch[..., k],
                "1",
                f"{tensor} of the patch itself, {component}",
                sparse=sparse,
            ).setncatts({"gauge_px": float(strain.subset_px)})
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
        dataset.createDimension("strain_component", len(_COMPONENTS))
        common = dataset.createVariable(
            "common_factor_strain",
            "f4",
            ("row", "col", "strain_component", "cause"),
            fill_value=np.nan,
            chunksizes=(*strain.common.shape[:2], 1, 1),
            **COLUMN_BY_COLUMN,
        )
        names = ", ".join(name for name, _ in _COMPONENTS)
        common.setncatts({"units": "1", "long_name": f"F: what all points share of the uncertainty of {names}"})
        dataset.put(common, strain.common.astype(np.float32, copy=False))
    status = dataset.createVariable(
        "strain_status", "i1", ("row", "col"), fill_value=False, compression="zlib", complevel=1
    )
    status.setncatts(
        {
            "units": "1",
            "long_name": "what can be said about the strain at the point",
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
    document = current_entries(json.loads(dataset.strain))
    variables = dataset.variables

    def stacked(suffix: str = "", prefix: str = "") -> Any:
        return np.stack(
            [np.asarray(variables[f"{prefix}{n}{suffix}"][...], dtype=np.float64) for n, _ in _COMPONENTS], axis=-1
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
    # older files have it under another name
    found = next((name for name in ("common_factor_strain", "strain_common_factor") if name in variables), None)
    if found is not None:
        common = np.asarray(variables[found][...], dtype=np.float64)
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
