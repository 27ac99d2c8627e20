"""The matcher's own unknowns of a step, in a file next to its result for as long as the analysis may continue from it.

A result file has the measured values; the start values of the next step are not all in it. An analysis that continues
in another process finds the same starts here, and computes the same numbers, to the last bit.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import Starts
from stereorig.server.formats.files import write_bytes

#: values that a result file holds in single precision
_SINGLE = ("covariance", "zncc", "epipolar_px", "noise_grey")


def starts_file(result: Path) -> Path:
    """Path of the starts that belong to a result file."""
    name = result.stem.replace("head_", "head_starts_") if result.stem.startswith("head") else result.stem
    return result.with_name(name.replace("step_", "starts_") + ".npz")


def write_starts(path: Path, measured: Field, *, exact: bool) -> None:
    """Write durably the parts of a measured field that its result file does not hold.

    Parameters
    ----------
    measured
        The field, with its starts.
    exact
        Also write in double precision the values that the result file has in single: for the reference, whose errors
        every step's are computed from, and for a step that may become a later reference.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``.
    """
    starts = measured.starts
    assert starts is not None
    arrays = {"w": starts.w} if starts.G is None else {"w": starts.w, "G": starts.G}
    if exact:
        arrays |= {name: getattr(measured, name) for name in _SINGLE}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # its stubs take a name for a flag
    write_bytes(path, buffer.getvalue())


def with_starts(measured: Field, path: Path) -> Field:
    """Return a field with the starts from the file next to its result; unreadable starts are searched again."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            exact = {name: arrays[name] for name in _SINGLE if name in arrays}
            return replace(measured, starts=Starts(arrays["w"], arrays.get("G")), **exact)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return measured
