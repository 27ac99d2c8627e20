"""NetCDF files, opened for reading and for writing by this module alone, under one lock.

In the classic model the library closes the definitions, and flushes all of the file, after every variable and attribute
that is added, as soon as it may: half a millisecond each. A new file's definitions are therefore all made before they
are closed once; its values follow.
"""

from __future__ import annotations

import contextlib
import errno
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.files import written_temporary
from stereorig.server.formats.manifest import is_there, require_sound

#: the netCDF and HDF5 libraries are not built for several threads at once
library = threading.RLock()
_NEARLY_FULL_BYTES = 1 << 20


class NewDataset(netCDF4.Dataset):
    """An empty data set whose values are written once all is defined: :meth:`put` and :meth:`finish`."""

    def __init__(self, *args: Any, **more: Any) -> None:
        # an attribute set in the usual way becomes an attribute of the file
        self.__dict__["_waiting"] = []
        super().__init__(*args, **more)

    def put(self, variable: Any, values: Any) -> None:
        """Write a variable's values when the definitions are closed; they must not change until then."""
        self.__dict__["_waiting"].append((variable, values))

    def finish(self) -> None:
        """Close the definitions and write the waiting variables."""
        super()._enddef()  # type: ignore[misc]
        waiting = self.__dict__["_waiting"]
        while waiting:
            variable, values = waiting.pop(0)
            variable.set_auto_maskandscale(False)  # they are as the file is to hold them
            if np.ndim(values) < 4:
                variable[...] = values
                continue
            for k in range(values.shape[2]):  # a part that the cache holds: its chunks are gathered from all of it
                variable[:, :, k] = values[:, :, k]

    def _redef(self) -> None:
        """Stay in the definitions, which a new file begins with; the base class calls it before each of them."""

    def _enddef(self) -> None:
        """Stay in the definitions; the base class calls it after each of them."""


@contextlib.contextmanager
def opened(path: Path, content: bytes | netCDF4.Dataset | None = None) -> Iterator[Any]:
    """Yield a file's data set to read; values come as they are stored, without masks.

    Parameters
    ----------
    content
        Content of the file, or its data set, which are then used instead of the path.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``; ``checksum_mismatch`` if it is not as it was written.
    """
    if isinstance(content, netCDF4.Dataset):
        yield content
        return
    if content is None and not is_there(path):
        raise FileFormatError(f"The result file {path} does not exist.", code="file_missing", remedy="Check the path.")
    if content is None:
        require_sound(path, just_read=True)
    with library:
        try:
            dataset = netCDF4.Dataset(path, "r", memory=content)
        except (OSError, RuntimeError, ValueError) as error:  # the last for names that are no text
            text = f"{path} cannot be read as a result file: {getattr(error, 'strerror', None) or 'it is damaged'}."
            raise FileFormatError(text, file=path.name) from error
        with dataset:
            dataset.set_auto_mask(False)
            yield dataset


@contextlib.contextmanager
def written_dataset(path: Path, *, classic: bool = True, checksum: bool = False) -> Iterator[Any]:
    """Yield a :class:`NewDataset`; on leaving, it is the file; see :func:`.formats.files.written_temporary`.

    Parameters
    ----------
    classic
        Keep to the classic model, which every reader takes; without it there are texts and unlimited dimensions.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    with written_temporary(path, checksum=checksum) as temporary:
        try:
            with (
                library,
                NewDataset(str(temporary), "w", format="NETCDF4_CLASSIC" if classic else "NETCDF4") as dataset,
            ):
                yield dataset
                dataset.finish()
        except RuntimeError as error:  # the HDF5 library's failed writes come without an errno
            full = shutil.disk_usage(temporary.parent).free < _NEARLY_FULL_BYTES
            raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from error


def add_scalars(path: Path, scalars: Iterable[tuple[str, float, str, str]]) -> None:
    """Add numbers without dimensions to a NetCDF-4 file: name, value, unit, meaning."""
    with library, netCDF4.Dataset(str(path), "a") as dataset:
        for name, value, units, meaning in scalars:
            made = dataset.createVariable(name, "f8", ())
            made.setncatts({"units": units, "long_name": meaning})
            made[...] = value


def rename_axes(path: Path, old: str, new: str) -> None:
    """Replace the name of the axes in every text of a file that speaks of them."""
    with library, netCDF4.Dataset(path, "a") as dataset:
        for variable in dataset.variables.values():
            if old in getattr(variable, "long_name", ""):
                variable.long_name = variable.long_name.replace(old, new)
        if "strain_axes" in dataset.ncattrs():
            dataset.strain_axes = dataset.strain_axes.replace(old, new)


def dataset_bytes(fill: Callable[[Any], None]) -> bytes:
    """Return the bytes of a NetCDF-4 file that ``fill`` puts into an empty data set."""
    with library:
        dataset = NewDataset("field.nc", "w", memory=1 << 16, format="NETCDF4_CLASSIC")
        fill(dataset)
        dataset.finish()
        return bytes(dataset.close())
