"""Text files of one name and one number a line."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.formats.calibrations.programs.imported_pair import (
    euler_zyx,
    invalid,
    opencv_lens,
    pair_of,
    unreadable,
)

MAX_LINE = 1000  # characters
_LOOKED_AT = 65536  # bytes of a file whose kind is asked


def has_line(data: bytes, begin: re.Pattern[bytes]) -> bool:
    """Return True if a line near the file's begin starts with this, blanks before it left out."""
    return any(begin.match(line.lstrip()) for line in data[:_LOOKED_AT].splitlines())


def named_numbers(
    data: bytes,
    *,
    name: str,
    parted: Callable[[str], tuple[str, str]],
    key_of: Callable[[str], str],
    is_remark: Callable[[str], bool],
) -> dict[str, float]:
    """Return the numbers of a file by their names.

    Parameters
    ----------
    data, name
        The file, and its name in errors.
    parted
        Splits a line into a name and a number; returns empty texts for a line that is neither.
    key_of
        Turns a name as written into the name that is looked up.
    is_remark
        True for a key whose value may be text, which is then left out.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` or ``calibration_invalid``.
    """
    values: dict[str, float] = {}
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        if not line.strip():
            continue
        written, text = parted(line) if len(line) <= MAX_LINE else ("", "")
        if not written or not text:
            raise unreadable(name, f"line {number} is no name and value")
        key = key_of(written)
        if key in values:
            raise unreadable(name, f"{written} occurs twice in it")
        try:
            if not text.isascii():  # other scripts' digits
                raise ValueError
            values[key] = float(text)
        except ValueError as error:
            if is_remark(key):
                continue
            raise unreadable(name, f"{written} is {text!r}, not a number") from error
        if not np.isfinite(values[key]):
            raise invalid(name, f"{written} is {text}")
    return values


# pyvale's stereo calibrations: one ``name,value`` a line.
#
# ``cam0_fx_px``, ``fy``, ``fs`` (skew), ``cx``, ``cy``, and ``cam0_k1``, ``k2``, ``p1``, ``p2``, ``k3`` as OpenCV's, of
# both cameras; then ``tx_mm ty_mm tz_mm`` and ``theta_deg phi_deg psi_deg`` of ``X_cam1 = R X_cam0 + T`` with
# R = Rz(psi) Ry(phi) Rx(theta). Its camera 0 is camera 1 here; it states no image size. The separator is the writer's
# choice: a comma, else a semicolon, a tab or blanks.

_PIXELS = ("fx", "fy", "fs", "cx", "cy")
_BENT = ("k1", "k2", "p1", "p2", "k3")
_SHIFT = ("tx_mm", "ty_mm", "tz_mm")
_ANGLES = ("theta_deg", "phi_deg", "psi_deg")
_BEGIN = re.compile(rb"cam[0-9]_f[xy]_px\b")
_MARKS = str.maketrans(",;", "  ")


def is_pyvale(data: bytes) -> bool:
    """Return True if the bytes are lines of pyvale's kind."""
    return has_line(data, _BEGIN)


def parse_pyvale(data: bytes, *, name: str) -> StereoPair:
    """Read a pyvale calibration; the system frame is its camera 0's.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` or ``calibration_invalid``.
    """
    values = named_numbers(data, name=name, parted=_parted, key_of=str, is_remark=lambda _: False)
    needed = [f"cam{k}_{key}_px" for k in (0, 1) for key in _PIXELS]
    needed += [f"cam{k}_{key}" for k in (0, 1) for key in _BENT]
    missing = [key for key in (*needed, *_SHIFT, *_ANGLES) if key not in values]
    if missing:
        raise unreadable(name, f"it lacks {', '.join(missing)}")
    lens1, lens2 = (_lens(values, f"cam{k}", name) for k in (0, 1))
    return pair_of(name, lens1, lens2, euler_zyx(*(values[key] for key in _ANGLES)), [values[key] for key in _SHIFT])


def _parted(line: str) -> tuple[str, str]:
    words = line.translate(_MARKS).split()
    return (words[0], words[1]) if len(words) == 2 else ("", "")


def _lens(values: dict[str, float], camera: str, name: str) -> OpenCVLens:
    numbers = {key: values[f"{camera}_{key}_px"] for key in _PIXELS} | {key: values[f"{camera}_{key}"] for key in _BENT}
    numbers["skew"] = numbers.pop("fs")
    return opencv_lens(name, camera, numbers)
