"""A folder of calibration views: dZ in the name where something moves by it, else the number of a free pose.

``cam1_+0.000mm.tif``, ``cam2_+5.000mm.tif`` and so on; ``cam1_000.tif``, ``cam2_000.tif``; both for mixtures.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS, CameraName

# read-back positions of the two stages may differ by some micrometres at one nominal position
PAIR_TOLERANCE_MM = 0.05
_NAME = re.compile(r"(?i)(cam[12])_(?:([+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))mm|([0-9]{1,9}))\.([a-z0-9]+)")
_ENDINGS = ("tif", "tiff", "png", "bmp", "jpg", "jpeg")
_EXAMPLE = (
    "Name the views cam1_+0.000mm.tif, cam2_+0.000mm.tif, cam1_+5.000mm.tif and so on; views of free poses "
    "cam1_000.tif, cam2_000.tif, cam1_001.tif and so on."
)


@dataclass(frozen=True)
class ViewFile:
    """One view's file: at a stage position, or of a free pose by its number."""

    camera: CameraName
    dz_mm: float | None
    path: Path
    frame: int | None = None


def views_of_pairs(cam1: Sequence[Path], cam2: Sequence[Path]) -> list[ViewFile]:
    """Return files of any names as views of free poses, the n-th of either camera as pose n, counted from 0."""
    lists: tuple[tuple[CameraName, Sequence[Path]], ...] = (("cam1", cam1), ("cam2", cam2))
    return [ViewFile(camera, None, path, k) for camera, files in lists for k, path in enumerate(files)]


def find_views(folder: Path) -> list[ViewFile]:
    """List the views in a folder, by camera, ascending dZ, then ascending numbers; other names are left alone.

    Raises
    ------
    InputError
        ``folder_missing``, ``views_missing`` (none there), ``view_duplicate`` (a position twice),
        ``view_missing`` (a position that only one camera has, or no free pose of one camera).
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
    other_ending: list[str] = []
    for path in entries:
        match = _NAME.fullmatch(path.name)
        if match and path.is_file():
            if match[4].lower() not in _ENDINGS:
                other_ending.append(path.name)
                continue
            camera: CameraName = "cam1" if match[1].lower() == "cam1" else "cam2"
            dz_mm = None if match[2] is None else float(match[2])
            views.append(ViewFile(camera, dz_mm, path, None if match[3] is None else int(match[3])))
    if not views:
        raise InputError(
            f"The folder {folder} holds {len(entries)} entries, but no view.{_not_read(other_ending)}",
            code="views_missing",
            remedy=_EXAMPLE,
        )
    views.sort(key=lambda v: (v.camera, v.dz_mm is None, v.dz_mm or 0.0, v.frame or 0))
    for a, b in pairwise(views):
        if a.camera == b.camera and _same_place(a, b):
            what = "position" if a.frame is None else "pose"
            raise InputError(
                f"{a.path.name} and {b.path.name} name the same {what}.",
                code="view_duplicate",
                remedy=f"Keep one view of each camera and {what}.",
            )
    staged = {name: [v for v in views if v.camera == name and v.dz_mm is not None] for name in CAMERAS}
    _check_pairs(staged["cam1"], staged["cam2"], "cam2", folder, other_ending)
    _check_pairs(staged["cam2"], staged["cam1"], "cam1", folder, other_ending)
    # a free pose may be seen by one camera only, but not every one
    free = {name: [v for v in views if v.camera == name and v.frame is not None] for name in CAMERAS}
    for name, other in zip(CAMERAS, CAMERAS[::-1], strict=True):
        if free[name] and not free[other]:
            raise InputError(
                f"{folder} holds {free[name][0].path.name}, but no free pose of {other}.{_not_read(other_ending)}",
                code="view_missing",
                remedy="Take every pose with both cameras.",
                camera=other,
            )
    return views


def _same_place(a: ViewFile, b: ViewFile) -> bool:
    if a.dz_mm is not None and b.dz_mm is not None:
        return abs(a.dz_mm - b.dz_mm) < 1e-9
    return a.frame is not None and a.frame == b.frame


def _not_read(names: Sequence[str]) -> str:
    """Name files of a view's name whose ending is none of an image format that is read, as a further sentence."""
    if not names:
        return ""
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f" {names[0]}{more} cannot be read by the ending: images end in {', '.join('.' + e for e in _ENDINGS)}."


def _check_pairs(
    own: Sequence[ViewFile], others: Sequence[ViewFile], other: str, folder: Path, other_ending: Sequence[str]
) -> None:
    for view in own:
        dz_mm = view.dz_mm or 0.0
        if not any(abs(dz_mm - (o.dz_mm or 0.0)) <= PAIR_TOLERANCE_MM for o in others):
            raise InputError(
                f"{folder} holds {view.path.name}, but no view of {other} at {dz_mm:+.3f} mm.{_not_read(other_ending)}",
                code="view_missing",
                remedy="Take every position with both cameras.",
                camera=other,
                dz_mm=view.dz_mm,
            )
