"""A field as an ``xarray.Dataset``: the variables and attributes of its result file, in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import netCDF4

from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.formats.results.netcdf import dataset_bytes, library
from stereorig.server.formats.results.variables import described
from stereorig.server.formats.results.writing import Provenance, fill

if TYPE_CHECKING:
    import xarray


def as_dataset(result: Field, provenance: Provenance, strain: StrainField | None = None) -> xarray.Dataset:
    """Return the dataset that ``xarray.open_dataset`` reads from the field's result file; each array has its frame.

    Raises
    ------
    InputError
        ``library_missing`` where xarray is not installed.
    """
    try:
        import xarray
        from xarray.backends import NetCDF4DataStore
    except ImportError as error:
        raise InputError(
            "xarray is not installed.", code="library_missing", remedy="pip install 'stereorig[xarray]'"
        ) from error
    data = dataset_bytes(lambda dataset: fill(dataset, result, provenance, strain))
    with library, netCDF4.Dataset("field.nc", memory=data) as held:
        return with_frame(xarray.open_dataset(NetCDF4DataStore(held)).load())  # type: ignore[no-untyped-call]


def with_frame(data: xarray.Dataset) -> xarray.Dataset:
    """Write a data set's frame into the attributes of each array over the points that depends on it."""
    for name, values in data.data_vars.items():
        if "row" in values.dims and described(str(name)).part != "none":
            values.attrs["frame"] = data.attrs["frame"]
    return data
