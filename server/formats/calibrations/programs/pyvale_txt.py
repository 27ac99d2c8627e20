"""pyvale's stereo calibrations: one ``name,value`` a line.

``cam0_fx_px``, ``fy``, ``fs`` (skew), ``cx``, ``cy``, and ``cam0_k1``, ``k2``, ``p1``, ``p2``, ``k3`` as OpenCV's, of
both cameras; then ``tx_mm ty_mm tz_mm`` and ``theta_deg phi_deg psi_deg`` of ``X_cam1 = R X_cam0 + T`` with
R = Rz(psi) Ry(phi) Rx(theta). Its camera 0 is camera 1 here; it states no image size. The separator is the writer's
choice: a comma, else a semicolon, a tab or blanks.
"""

from __future__ import annotations

import re

from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.formats.calibrations.programs.imported_pair import euler_zyx, opencv_lens, pair_of, unreadable
from stereorig.server.formats.calibrations.programs.named_numbers import has_line, named_numbers

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
