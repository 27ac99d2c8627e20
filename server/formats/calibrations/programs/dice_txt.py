"""DICe's text camera files: one number a line, a ``#`` begins a comment.

``cx cy fx fy fs k1 k2 k3`` of camera 0, then of camera 1, pixels; then ``alpha beta gamma`` in degrees with
R = Rz(gamma) Ry(beta) Rx(alpha), or ``R11 R12 ... R33`` by rows; then ``tx ty tz`` of ``X_cam1 = R X_cam0 + T``; newer
files end with the images' height and width. DICe's camera 0 is camera 1 here.

DICe's own calibration, on OpenCV, wrote k1 and k2 of OpenCV's ``1 + k1 r^2 + k2 r^4`` and its k6 in the third place,
with the comment ``k6``; files made from VIC-3D hold that program's k1 k2 k3, of the same powers. So they are taken
here. DICe's report on triangulation has these powers, over cx instead of the focal length; its newer programs read the
numbers as a factor ``1 + k1 + k2 r + k3 r^2``, which no lens has.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.formats.calibrations.programs.imported_pair import (
    MAX_SIDE_PX,
    ImageSize,
    euler_zyx,
    invalid,
    opencv_lens,
    pair_of,
    proper_rotation,
    unreadable,
    unsupported,
)

LENS_NOTE = (
    "k1 k2 k3 were taken as factors of r^2, r^4, r^6, as OpenCV and VIC-3D have them; DICe itself reads them in "
    "another way: check the calibration with points that it has measured"
)
_LENS = ("cx", "cy", "fx", "fy", "fs", "k1", "k2", "k3")
_ANGLES = ("alpha", "beta", "gamma")
_MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
_SHIFT = ("tx", "ty", "tz")
_SIZE = ("height", "width")
_KNOWN = {*_LENS, *_ANGLES, *_MATRIX, *_SHIFT, "k6"}
_LAYOUTS = {
    len(names): names
    for rotation in (_ANGLES, _MATRIX)
    for size in ((), _SIZE)
    for names in [(*_LENS, *_LENS, *rotation, *_SHIFT, *size)]
}
_WORD = re.compile(r"[A-Za-z0-9_]*")
_FEWEST = 8  # of the 22 and more numbers, so that a truncated file is still recognised as DICe's


@dataclass(frozen=True)
class _Entry:
    """A line's number, and the first word of its comment in small letters."""

    line: int
    text: str
    word: str


def is_dice_txt(data: bytes) -> bool:
    """Return True if the bytes are lines of one number each, with comments or without."""
    entries = _entries(data)
    return (
        entries is not None and len(entries) >= _FEWEST and all(_is_number(entry.text) for entry in entries[:_FEWEST])
    )


def parse_dice_txt(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize, tuple[str, ...]]:
    """Read a DICe text camera file; the system frame is its camera 0's.

    Returns
    -------
    tuple
        The pair, both images' size (width, height), None if the file has none, and notes on the assumptions made.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_unsupported`` (a TRANSFORM), ``calibration_invalid``.
    """
    entries = _entries(data)
    if entries is None:
        raise unreadable(name, "a line holds more than a number and a comment")
    if any(entry.text.upper() == "TRANSFORM" for entry in entries):
        raise unsupported(name, "it has a TRANSFORM to another frame, which DICe no longer reads either")
    names = _LAYOUTS.get(len(entries))
    if names is None:
        counts = ", ".join(map(str, sorted(_LAYOUTS)))
        raise unreadable(name, f"it has {len(entries)} numbers; DICe's text files have {counts}")
    values = [_value(name, entry, expected) for entry, expected in zip(entries, names, strict=True)]
    n = len(_LENS)
    lenses = [_lens(name, k, entries[k * n : (k + 1) * n], values[k * n : (k + 1) * n]) for k in (0, 1)]
    rest = dict(zip(names[2 * n :], values[2 * n :], strict=True))
    if "r11" in rest:
        rotation = proper_rotation(name, "R", np.array([rest[key] for key in _MATRIX]).reshape(3, 3))
    else:
        rotation = euler_zyx(*(rest[key] for key in _ANGLES))
    size: ImageSize = None
    if "width" in rest and 0 < rest["width"] <= MAX_SIDE_PX and 0 < rest["height"] <= MAX_SIDE_PX:
        size = (int(rest["width"]), int(rest["height"]))
    bent = any(any((lens.k1, lens.k2, lens.k3, lens.k6)) for lens in lenses)
    pair = pair_of(name, lenses[0], lenses[1], rotation, [rest[key] for key in _SHIFT])
    return pair, size, (LENS_NOTE,) if bent else ()


def _entries(data: bytes) -> list[_Entry] | None:
    """The lines with a number; None where a line holds anything else."""
    found = []
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        text, _, comment = line.partition("#")
        words, word = text.split(), _WORD.match(comment.lstrip())
        if len(words) != 1:
            return None
        found.append(_Entry(number, words[0], word[0].lower() if word else ""))
    return found


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.isascii()


def _value(name: str, entry: _Entry, expected: str) -> float:
    if entry.word in _KNOWN and entry.word != expected and (entry.word, expected) != ("k6", "k3"):
        raise unreadable(name, f"line {entry.line} is commented {entry.word}, where {expected} belongs")
    if not _is_number(entry.text):
        raise unreadable(name, f"{expected} in line {entry.line} is {entry.text!r}, not a number")
    value = float(entry.text)
    if not np.isfinite(value):
        raise invalid(name, f"{expected} in line {entry.line} is {entry.text}")
    return value


def _lens(name: str, camera: int, entries: list[_Entry], values: list[float]) -> OpenCVLens:
    numbers = dict(zip(_LENS, values, strict=True))
    numbers["skew"] = numbers.pop("fs")
    if entries[-1].word == "k6":
        numbers["k6"] = numbers.pop("k3")
    return opencv_lens(name, f"camera {camera}", numbers)
