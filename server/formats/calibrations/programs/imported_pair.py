"""A stereo pair from another program's numbers, after they were checked.

Imported rigs keep their own lens model (OpenCV's fourteen coefficients); the system frame is camera 1's own frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.opencv_full import PRISM_TERMS, opencv_lens_of
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import FileFormatError, InputError

ImageSize = tuple[int, int] | None
"""Columns and rows, where a program's file states them."""

LENGTHS_MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3, "in": 25.4}
"""Units of length in millimetres."""

_SIZE = re.compile(r"([0-9.eE+-]{1,20}) ?(um|mm|cm|m|in)")
MAX_SIDE_PX = 1 << 20  # of an image size that a file states
_MIN_BASELINE_MM = 1e-9  # two equal poses, composed, leave the digits' end
_ROTATION_TOLERANCE = 1e-4  # files carry six digits and more; a wrong axis order is off by far more


def unit_mm(unit: str) -> float:
    """Return the millimetres of a unit of length: ``m``, or a size such as ``25 mm``, as of a board's square.

    Raises
    ------
    InputError
        ``calibration_unit_unknown``.
    """
    named = LENGTHS_MM.get(unit.strip())
    found = _SIZE.fullmatch(unit.strip())
    try:
        size = named or (0.0 if found is None else float(found[1]) * LENGTHS_MM[found[2]])
    except ValueError:
        size = 0.0
    if not 1e-6 < size < 1e6:  # NaN too
        raise InputError(
            f"The unit {unit[:40]!r} is no length.",
            code="calibration_unit_unknown",
            remedy=f"Give one of {', '.join(LENGTHS_MM)}, or a size, as '25 mm' where T counts a board's squares.",
        )
    return size


def unreadable(name: str, why: str, *, remedy: str | None = None) -> FileFormatError:
    """Return the error for a file that is no calibration of its kind."""
    return FileFormatError(
        f"{name} cannot be read as a calibration: {why}.",
        code="calibration_unreadable",
        remedy=remedy
        or "Give a calibration.json, a DICe XML camera system or text camera file, an OpenCV YAML stereo "
        "calibration, a MatchID caldat, a VIC-3D file or a pyvale text.",
    )


def unsupported(name: str, why: str) -> FileFormatError:
    """Return the error for a calibration that the camera models here cannot carry."""
    return FileFormatError(
        f"The calibration {name} cannot be carried over exactly: {why}.",
        code="calibration_unsupported",
        remedy="Calibrate again with OpenCV's model, or with this program.",
    )


def invalid(name: str, why: str) -> FileFormatError:
    """Return the error for numbers that describe no pair of cameras."""
    return FileFormatError(
        f"The calibration {name} describes no pair of cameras: {why}.",
        code="calibration_invalid",
        remedy="Export the calibration again from the program that made it.",
    )


def proper_rotation(name: str, entry: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return the nearest rotation to a (3, 3) matrix, after checking that it is one to the digits of a text file."""
    R = np.asarray(values, dtype=np.float64)
    if R.shape != (3, 3):
        raise unreadable(name, f"{entry} has the shape {R.shape}, not (3, 3)")
    if not np.isfinite(R).all():
        raise invalid(name, f"{entry} holds a number that is not finite")
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
        raise invalid(name, f"{entry} is not a rotation (R R^T is off by {off:.2g}, det {np.linalg.det(R):+.3f})")
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)


def opencv_lens(name: str, which: str, values: Mapping[str, float]) -> OpenCVLens:
    """Build one lens from ``fx fy cx cy`` and, where given, ``skew``, ``k1`` to ``k6``, ``s1`` to ``s4`` and tau."""
    for key, value in values.items():
        if not np.isfinite(value):
            raise invalid(name, f"{key} of {which} is {value}")
    for key in ("fx", "fy"):
        if not values[key] > 0.0:
            raise invalid(name, f"{key} of {which} is {values[key]:g}, not positive")
    names = {k: f"{k}_px" for k in ("fx", "fy", "cx", "cy", "skew")} | {k: f"{k}_rad" for k in ("tau_x", "tau_y")}
    names |= {k: k for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", *PRISM_TERMS)}
    return opencv_lens_of({names[k]: value for k, value in values.items() if k in names})


def pair_of(
    name: str, lens1: OpenCVLens, lens2: OpenCVLens, rotation: ArrayLike, translation_mm: ArrayLike
) -> StereoPair:
    """Build the pair from ``X_cam2 = R X_cam1 + T``; the system frame is camera 1's.

    Raises
    ------
    FileFormatError
        ``calibration_invalid`` if R is no rotation, T not finite, or both cameras have one position.
    """
    R = proper_rotation(name, "R", rotation)
    t = np.asarray(translation_mm, dtype=np.float64).ravel()
    if t.shape != (3,):
        raise unreadable(name, f"T has {t.size} numbers, not 3")
    if not np.isfinite(t).all():
        raise invalid(name, "T holds a number that is not finite")
    if not np.linalg.norm(t) > _MIN_BASELINE_MM:
        raise invalid(name, "both cameras have the same position (T is zero)")
    return StereoPair(Camera(lens1, RigidTransform.identity()), Camera(lens2, RigidTransform(R, t)))


def euler_zyx(alpha_deg: float, beta_deg: float, gamma_deg: float) -> NDArray[np.float64]:
    """Return ``Rz(gamma) Ry(beta) Rx(alpha)``, angles in degrees."""
    (ca, cb, cg), (sa, sb, sg) = (f(np.radians([alpha_deg, beta_deg, gamma_deg])) for f in (np.cos, np.sin))
    rz = np.array([[cg, -sg, 0.0], [sg, cg, 0.0], [0.0, 0.0, 1.0]])
    ry = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    return np.asarray(rz @ ry @ rx)


def euler_zyx_deg(rotation: NDArray[np.float64]) -> list[float]:
    """Return the angles alpha, beta, gamma of :func:`euler_zyx`; alpha is zero where beta is a right angle."""
    beta = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    if np.hypot(rotation[2, 1], rotation[2, 2]) > 1e-9:
        alpha = np.arctan2(rotation[2, 1], rotation[2, 2])
        gamma = np.arctan2(rotation[1, 0], rotation[0, 0])
    else:  # alpha and gamma turn about one axis then
        alpha, gamma = 0.0, np.arctan2(-rotation[0, 1], rotation[1, 1])
    return [float(v) for v in np.degrees([alpha, beta, gamma])]
