"""A folder of calibration views: ``cam1_+0.000mm.tif``, ``cam2_+5.000mm.tif`` and so on, dZ in the name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from core.errors import InputError
from core.names import CAMERAS, CameraName

# read-back positions of the two stages may differ by some micrometres at one nominal position
PAIR_TOLERANCE_MM = 0.05
_NAME = re.compile(r"(?i)(cam[12])_([+-]?(?:\d+\.?\d*|\.\d+))mm\.(?:tif|tiff|png)")
_EXAMPLE = "Name the views cam1_+0.000mm.tif, cam2_+0.000mm.tif, cam1_+5.000mm.tif and so on."


@dataclass(frozen=True)
class ViewFile:
    """One view's file."""

    camera: CameraName
    dz_mm: float
    path: Path


def find_views(folder: Path) -> list[ViewFile]:
    """List the views in a folder, by camera and ascending dZ; files of other names are left alone.

    Raises
    ------
    InputError
        ``folder_missing``, ``views_missing`` (none there), ``view_duplicate`` (a position twice),
        ``view_missing`` (a position that only one camera has).
    """
    try:
        entries = sorted(folder.iterdir())
    except FileNotFoundError as error:
        raise InputError(
            f"The folder of views {folder} does not exist.", code="folder_missing", remedy="Check the path."
        ) from error
    except OSError as error:
        raise InputError(
            f"The folder of views {folder} cannot be read ({error.strerror or error}).",
            code="folder_missing",
            remedy="Give a folder that holds the views.",
        ) from error
    views = []
    for path in entries:
        match = _NAME.fullmatch(path.name)
        if match and path.is_file():
            camera: CameraName = "cam1" if match[1].lower() == "cam1" else "cam2"
            views.append(ViewFile(camera, float(match[2]), path))
    if not views:
        raise InputError(
            f"The folder {folder} holds {len(entries)} entries, but no view.", code="views_missing", remedy=_EXAMPLE
        )
    views.sort(key=lambda v: (v.camera, v.dz_mm))
    for a, b in pairwise(views):
        if a.camera == b.camera and abs(a.dz_mm - b.dz_mm) < 1e-9:
            raise InputError(
                f"{a.path.name} and {b.path.name} name the same position.",
                code="view_duplicate",
                remedy="Keep one view of each camera and position.",
            )
    by_camera = {name: [v for v in views if v.camera == name] for name in CAMERAS}
    _check_pairs(by_camera["cam1"], by_camera["cam2"], "cam2", folder)
    _check_pairs(by_camera["cam2"], by_camera["cam1"], "cam1", folder)
    return views


def _check_pairs(own: Sequence[ViewFile], others: Sequence[ViewFile], other: str, folder: Path) -> None:
    for view in own:
        if not any(abs(view.dz_mm - o.dz_mm) <= PAIR_TOLERANCE_MM for o in others):
            raise InputError(
                f"{folder} holds {view.path.name}, but no view of {other} at {view.dz_mm:+.3f} mm.",
                code="view_missing",
                remedy="Take every position with both cameras.",
                camera=other,
                dz_mm=view.dz_mm,
            )
