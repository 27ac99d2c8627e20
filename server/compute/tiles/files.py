"""The folder of a step's tiles: what is to be fitted, who has taken it, and what came of it.

A file appears whole, under its name, or not at all; a tile is taken by whoever makes its claim first. Nothing is synced
to disk: after a crash nobody wants it.
"""

from __future__ import annotations

import os
import secrets
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from core.field.points.crew import ToFit
from core.field.points.fitter import PointFits
from core.matching.arguments import VisiblePixels


def put_tile(folder: Path, k: int, points: ToFit, visible: VisiblePixels | None) -> None:
    """Write what is to be fitted.

    Raises
    ------
    OSError
    """
    arrays: dict[str, Any] = {"xy_px": points.xy_px, "w": points.w, "far_px": np.float64(points.far_px)}
    if points.G is not None:
        arrays["G"] = points.G
    if visible is not None:
        used = np.unique(visible.of_point[visible.of_point >= 0])
        place = np.full(len(visible.patches) + 1, -1, np.int32)  # the last one: all of a subset
        place[used] = np.arange(len(used))
        arrays |= {"patches": visible.patches[used], "of_point": place[visible.of_point]}
    _put(folder / f"tile_{k:04d}.npz", arrays)


def tile_in(folder: Path, k: int) -> tuple[ToFit, VisiblePixels | None]:
    """Return what is to be fitted.

    Raises
    ------
    OSError
        The tile is not wanted any more.
    """
    with np.load(folder / f"tile_{k:04d}.npz", allow_pickle=False) as found:
        points = ToFit(found["xy_px"], found["w"], found.get("G"), float(found["far_px"]))
        visible = VisiblePixels(found["patches"], found["of_point"]) if "patches" in found else None
    return points, visible


def claim(folder: Path, k: int) -> bool:
    """Take a tile; False if it is taken, or not wanted any more."""
    try:
        os.close(os.open(folder / f"taken_{k:04d}", os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except OSError:
        return False
    return True


def put_fits(folder: Path, k: int, fits: PointFits) -> None:
    """Write what came of a tile.

    Raises
    ------
    OSError
        The tile is not wanted any more.
    """
    arrays = {f.name: getattr(fits, f.name) for f in fields(fits)}
    _put(folder / f"fits_{k:04d}.npz", {name: array for name, array in arrays.items() if array is not None})


def fits_in(folder: Path, k: int) -> PointFits | None:
    """Return what came of a tile; None if nothing has yet, or nothing that can be read."""
    try:
        with np.load(folder / f"fits_{k:04d}.npz", allow_pickle=False) as found:
            return PointFits(**{name: found[name] for name in found.files})
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None


def _put(path: Path, arrays: Mapping[str, Any]) -> None:
    temporary = path.with_name(f".{secrets.token_hex(4)}.npz")
    np.savez(temporary, **arrays)
    temporary.replace(path)
