"""pyvale's stereo calibrations: one ``name,value`` a line.

``cam0_fx_px``, ``fy``, ``fs`` (skew), ``cx``, ``cy``, and ``cam0_k1``, ``k2``, ``p1``, ``p2``, ``k3`` as OpenCV's, of
both cameras; then ``tx_mm ty_mm tz_mm`` and ``theta_deg phi_deg psi_deg`` of ``X_cam1 = R X_cam0 + T`` with
R = Rz(psi) Ry(phi) Rx(theta). Its camera 0 is camera 1 here; it states no image size. The separator is the writer's
choice: a comma, else a semicolon, a tab or blanks.
"""

from __future__ import annotations

import re

import numpy as np

from core.cameras.lens import OpenCVLens
from core.cameras.stereo import StereoPair
from server.formats.calibrations.programs.imported_pair import euler_zyx, invalid, opencv_lens, pair_of, unreadable

_PIXELS = ("fx", "fy", "fs", "cx", "cy")
_BENT = ("k1", "k2", "p1", "p2", "k3")
_SHIFT = ("tx_mm", "ty_mm", "tz_mm")
_ANGLES = ("theta_deg", "phi_deg", "psi_deg")
_LINE = re.compile(r"\s*(\w+)\s*(?:[,;\t]|\s)\s*([^\s,;]+)\s*[,;]?\s*")


def is_pyvale(data: bytes) -> bool:
    """Return True if the bytes are lines of pyvale's kind."""
    return re.search(rb"^\s*cam\d_f[xy]_px\b", data[:65536], re.MULTILINE) is not None


def parse_pyvale(data: bytes, *, name: str) -> StereoPair:
    """Read a pyvale calibration; the system frame is its camera 0's.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` or ``calibration_invalid``.
    """
    values = _values(data, name)
    needed = [f"cam{k}_{key}_px" for k in (0, 1) for key in _PIXELS]
    needed += [f"cam{k}_{key}" for k in (0, 1) for key in _BENT]
    missing = [key for key in (*needed, *_SHIFT, *_ANGLES) if key not in values]
    if missing:
        raise unreadable(name, f"it lacks {', '.join(missing)}")
    lens1, lens2 = (_lens(values, f"cam{k}", name) for k in (0, 1))
    return pair_of(name, lens1, lens2, euler_zyx(*(values[key] for key in _ANGLES)), [values[key] for key in _SHIFT])


def _values(data: bytes, name: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        if not line.strip():
            continue
        found = _LINE.fullmatch(line)
        if found is None:
            raise unreadable(name, f"line {number} is no name and value")
        key, text = found[1], found[2]
        if key in values:
            raise unreadable(name, f"{key} occurs twice in it")
        try:
            values[key] = float(text)
        except ValueError as error:
            raise unreadable(name, f"{key} is {text!r}, not a number") from error
        if not np.isfinite(values[key]):
            raise invalid(name, f"{key} is {text}")
    return values


def _lens(values: dict[str, float], camera: str, name: str) -> OpenCVLens:
    numbers = {key: values[f"{camera}_{key}_px"] for key in _PIXELS} | {key: values[f"{camera}_{key}"] for key in _BENT}
    numbers["skew"] = numbers.pop("fs")
    return opencv_lens(name, camera, numbers)
