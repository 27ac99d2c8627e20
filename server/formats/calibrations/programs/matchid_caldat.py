"""MatchID's calibration files (``*.caldat``): one ``name;value`` a line.

``Cam0_Fx [pixels]`` and so on for both cameras, Fs the skew in pixels, Kappa 1 to 3, P1, P2 as OpenCV's k1 k2 k3 p1
p2; then ``Tx [mm]``, ``Theta [deg]``, ``Phi [deg]``, ``Psi [deg]`` of ``X_cam1 = R X_cam0 + T`` with
``R = Rz(Psi) Ry(Phi) Rx(Theta)``. Some programs count the cameras from 1. The format is not published; this is how
several public programs read and write it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.formats.calibrations.programs.imported_pair import (
    euler_zyx,
    euler_zyx_deg,
    opencv_lens,
    pair_of,
    unreadable,
    unsupported,
)
from stereorig.server.formats.calibrations.programs.named_numbers import has_line, named_numbers

_CAMERA = {
    "fx": "Fx [pixels]",
    "fy": "Fy [pixels]",
    "skew": "Fs [pixels]",
    "k1": "Kappa 1",
    "k2": "Kappa 2",
    "k3": "Kappa 3",
    "p1": "P1",
    "p2": "P2",
    "cx": "Cx [pixels]",
    "cy": "Cy [pixels]",
}
_ATTRIBUTES = {"fx": "fx_px", "fy": "fy_px", "skew": "skew_px", "cx": "cx_px", "cy": "cy_px"}
_NEEDED = ("fx", "fy", "cx", "cy")
_POSE = ("Tx [mm]", "Ty [mm]", "Tz [mm]", "Theta [deg]", "Phi [deg]", "Psi [deg]")
_BEGIN = re.compile(rb"cam[0-9]_f[xy]\b", re.IGNORECASE)
_CAMERA_KEY = re.compile(r"cam[0-9]_")
_STATED = re.compile(rb"^\s{0,9}(T[xyz]|theta|phi|psi)\s{0,9}\[\s{0,9}([^\[\]\s]{0,20})", re.IGNORECASE | re.MULTILINE)
_UNITS = {True: (b"", b"mm"), False: (b"", b"deg", b"degree", b"degrees", "°".encode(), b"\xb0")}
_UNIT = re.compile(r"\[[^\[\]]*\]|\s+")


def is_caldat(data: bytes) -> bool:
    """Return True if the bytes are lines of MatchID's kind."""
    return has_line(data, _BEGIN)


def parse_caldat(data: bytes, *, name: str) -> StereoPair:
    """Read a MatchID calibration; the system frame is its first camera's.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_invalid``, or ``calibration_unsupported`` for other units.
    """
    for key, unit in _STATED.findall(data):
        if unit.lower() not in _UNITS[key[:1] in b"tT" and len(key) == 2]:
            raise unsupported(name, f"it has {key.decode()} in {unit.decode('ascii', 'replace')}, not in mm or deg")
    values = named_numbers(data, name=name, parted=_parted, key_of=_key, is_remark=_is_remark)
    prefixes = sorted({key.split("_", 1)[0] for key in values if _CAMERA_KEY.match(key)})
    if len(prefixes) != 2:
        raise unreadable(name, f"it names the cameras {', '.join(prefixes) or 'none'}; a pair has two")
    lens1, lens2 = (_lens(values, prefix, name) for prefix in prefixes)
    missing = [key for key in _POSE if _key(key) not in values]
    if missing:
        raise unreadable(name, f"it lacks {', '.join(missing)}")
    x, y, z, theta, phi, psi = (values[_key(key)] for key in _POSE)
    return pair_of(name, lens1, lens2, euler_zyx(theta, phi, psi), np.array([x, y, z]))


def _key(text: str) -> str:
    """A name without unit, blanks and case: programs differ in these."""
    return _UNIT.sub("", text).lower()


def _parted(line: str) -> tuple[str, str]:
    at = min((k for k in map(line.find, ";=:") if k >= 0), default=len(line))
    words = line[at + 1 :].split()
    return line[:at].strip(), words[0] if len(words) == 1 else ""


def _is_remark(key: str) -> bool:
    return _CAMERA_KEY.match(key) is None and key not in {_key(k) for k in _POSE}


def _lens(values: Mapping[str, float], prefix: str, name: str) -> OpenCVLens:
    found = {short: values[key] for short, text in _CAMERA.items() if (key := f"{prefix}_{_key(text)}") in values}
    missing = [_CAMERA[short] for short in _NEEDED if short not in found]
    if missing:
        raise unreadable(name, f"{prefix} lacks {', '.join(missing)}")
    return opencv_lens(name, prefix, found)


def caldat_text(lens1: OpenCVLens, lens2: OpenCVLens, pair: StereoPair) -> str:
    """Return a calibration as MatchID writes it."""
    lines = []
    for prefix, lens in (("Cam0", lens1), ("Cam1", lens2)):
        lines += [f"{prefix}_{text};{getattr(lens, _ATTRIBUTES.get(key, key))!r}" for key, text in _CAMERA.items()]
    pose = pair.cam2_from_cam1
    numbers = [*pose.translation_mm.tolist(), *euler_zyx_deg(pose.rotation)]
    lines += [f"{text};{number!r}" for text, number in zip(_POSE, numbers, strict=True)]
    return "\n".join(lines) + "\n"
