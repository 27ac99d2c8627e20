"""The matcher's own unknowns of a step, kept beside its result for as long as the analysis may have to go on from it.

A result file has what was measured; what the next step starts from is not all in it. An analysis that goes on in
another process finds the same starts here, and comes to the same numbers, to the last bit.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from core.field.points.starts import Starts
from server.formats.files import write_bytes


def starts_file(result: Path) -> Path:
    """Where the starts lie that belong to a result file."""
    return result.with_name(result.stem.replace("step_", "starts_") + ".npz")


def write_starts(path: Path, starts: Starts) -> None:
    """Write them durably.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``.
    """
    arrays = {"w": starts.w} if starts.G is None else {"w": starts.w, "G": starts.G}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # its stubs take a name for a flag
    write_bytes(path, buffer.getvalue())


def read_starts(path: Path) -> Starts | None:
    """Read them back; None where there are none, or none that can be read: starts are found anew then."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Starts(arrays["w"], arrays.get("G"))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
