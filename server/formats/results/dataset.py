"""A field as an ``xarray.Dataset``: the variables and attributes of its result file, in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import netCDF4

from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.formats.results.netcdf import dataset_bytes, library
from stereorig.server.formats.results.writing import Provenance, fill

if TYPE_CHECKING:
    import xarray


def as_dataset(result: Field, provenance: Provenance, strain: StrainField | None = None) -> xarray.Dataset:
    """Return the dataset that ``xarray.open_dataset`` reads from the field's result file.

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
        return xarray.open_dataset(NetCDF4DataStore(held)).load()  # type: ignore[no-untyped-call]
