"""Lists of image files as steps: patterns expanded, files paired in sorted order."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.errors import FileFormatError, ImageError, InputError
from stereorig.core.names import CAMERAS
from stereorig.server.compute.tasks import averages_of, grey_from_of


@dataclass(frozen=True)
class ImagePair:
    """The two image files of one step, its number in its test, and its record (None without one)."""

    cam1: Path
    cam2: Path
    number: int | None = None
    sha256_1: str | None = None
    sha256_2: str | None = None
    averages: tuple[int, float] = (1, 1.0)
    grey_from: tuple[str | None, str | None] = (None, None)


def _natural(path: str) -> list[tuple[int, str]]:
    return [
        (int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", path)
    ]


def expand(option: str, items: Sequence[str]) -> tuple[list[Path], str | None]:
    """Expand patterns and paths to files in sorted order.

    Parameters
    ----------
    option
        ``--cam1`` or ``--cam2``, for messages.
    items
        Paths and patterns; a pattern that is itself the name of a file is that file.

    Returns
    -------
    tuple
        The files without repeats, and a note where sorted order is not the numbers' order.

    Raises
    ------
    ImageError
        ``file_missing`` if a path does not exist or a pattern matches nothing.
    """
    found: set[str] = set()
    for item in items:
        if Path(item).is_file():
            found.add(item)
            continue
        matches = [m for m in glob.glob(item) if Path(m).is_file()]  # noqa: PTH207 - patterns may be absolute
        if not matches:
            cause = f"The image {item} does not exist." if not glob.has_magic(item) else f"No file matches {item}."
            raise ImageError(
                f"{option}: {cause}",
                code="file_missing",
                remedy="Check the path; quote patterns so that the shell leaves them alone.",
            )
        found.update(matches)
    files = sorted(found)
    by_number = sorted(found, key=_natural)
    note = None
    if files != by_number:
        k = next(i for i, (a, b) in enumerate(zip(files, by_number, strict=True)) if a != b)
        note = (
            f"{option}: files are taken in sorted order, so {Path(files[k]).name} comes before "
            f"{Path(by_number[k]).name}; number them with leading zeros if that is not meant"
        )
    return [Path(f) for f in files], note


def pair_up(cam1: Sequence[Path], cam2: Sequence[Path]) -> list[ImagePair]:
    """Pair two lists of files.

    Raises
    ------
    InputError
        ``counts_differ`` if the lists differ in length, ``same_image`` if a file is in both.
    """
    if len(cam1) != len(cam2):
        raise InputError(
            f"--cam1 gives {len(cam1)} images ({cam1[0].name} ...) and --cam2 gives {len(cam2)} ({cam2[0].name} ...).",
            code="counts_differ",
            remedy="Give one image of each camera for every step.",
        )
    for a, b in zip(cam1, cam2, strict=True):
        if a.resolve() == b.resolve():
            raise InputError(
                f"{a} is given as camera 1's image and as camera 2's.",
                code="same_image",
                remedy="Give each camera its own images.",
            )
    return [ImagePair(a, b) for a, b in zip(cam1, cam2, strict=True)]


def pairs_of_test_folder(folder: Path) -> list[ImagePair]:
    """List the steps of a test folder (``steps/<nnnn>/cam1.tif cam2.tif step.json``).

    A folder without ``step.json`` is an incomplete step and is left out.

    Raises
    ------
    InputError
        ``file_missing``, ``no_steps``; ``reference_missing`` or ``step_missing`` where a step's folder is gone.
    FileFormatError
        If a ``step.json`` is damaged.
    """
    if not folder.is_dir():
        raise InputError(f"The test folder {folder} does not exist.", code="file_missing", remedy="Check the path.")
    _check_steps(folder)
    pairs = []
    for mark in sorted(folder.glob("steps/*/step.json")):
        try:
            record = json.loads(mark.read_text())
        except (ValueError, OSError) as error:
            raise FileFormatError(f"{mark} cannot be read as a step's record ({error}).") from error
        number = int(mark.parent.name) if _is_number(mark.parent) else None
        known = record if isinstance(record, dict) else {}
        images = mark.parent / "cam1.tif", mark.parent / "cam2.tif"
        pairs.append(ImagePair(*images, number, *_hashes(record), averages_of(known), grey_from_of(known)))
    if not pairs:
        raise InputError(
            f"{folder} holds no complete step (steps/<nnnn>/ with cam1.tif, cam2.tif and step.json).",
            code="no_steps",
            remedy="Give the folder of a test, or --cam1 and --cam2.",
        )
    return pairs


def _is_number(folder: Path) -> bool:
    return folder.name.isascii() and folder.name.isdigit()


def _check_steps(folder: Path) -> None:
    """Refuse a test whose steps do not begin with the reference or have a gap; an incomplete step keeps its folder."""
    complete = [int(mark.parent.name) for mark in folder.glob("steps/*/step.json") if _is_number(mark.parent)]
    if not complete:
        return
    remedy = "Restore it from a backup, or give the images that are left with --cam1 and --cam2."
    if 0 not in complete:
        raise InputError(
            f"The reference, step 0, of {folder} is missing or incomplete.", code="reference_missing", remedy=remedy
        )
    known = {int(path.name) for path in folder.glob("steps/*") if _is_number(path)}
    gone = [n for n in range(max(complete)) if n not in known]
    if gone:
        raise InputError(
            f"Step {gone[0]} of {folder} is gone; it has steps up to {max(complete)}.",
            code="step_missing",
            remedy=remedy,
        )


def _hashes(record: object) -> tuple[str | None, str | None]:
    hashes = record.get("sha256") if isinstance(record, dict) else None
    if not isinstance(hashes, dict):
        return None, None
    return tuple(str(hashes[cam]) if cam in hashes else None for cam in CAMERAS)  # type: ignore[return-value]
