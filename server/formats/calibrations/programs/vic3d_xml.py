"""Calibrations of VIC-3D: the ``calibration`` element of its project and calibration files.

Each camera holds ``cx cy fx fy skew k1 k2 k3`` (pixels) and ``<orientation>alpha beta gamma tx ty tz</orientation>``:
degrees and millimetres, ``X_cam = R X_world + T`` with ``R = Rz(gamma) Ry(beta) Rx(alpha)``. Newer files give
``<intrinsics>cx cy fx fy skew</intrinsics>`` and ``<distortion>k1 k2 k3</distortion>``.

The lens polynomial is not published. Taken here: ``x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6)`` in normalised
coordinates, undistorted to distorted, as its authors' book has the radial terms; the first two camera values as x, y.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.formats.calibrations.programs.imported_pair import (
    ImageSize,
    euler_zyx,
    euler_zyx_deg,
    invalid,
    opencv_lens,
    pair_of,
    unreadable,
    unsupported,
)
from stereorig.server.formats.xml_tree import read_side_by_side

_INTRINSICS = ("cx", "cy", "fx", "fy", "skew")
_SIZE = re.compile(r"0*[1-9][0-9]{0,5}")
_DISTORTION = ("k1", "k2", "k3")


def is_vic3d(data: bytes) -> bool:
    """Return True if the bytes are XML with VIC-3D's calibration."""
    return b"<calibration" in data and b"<camera" in data and b"<orientation" in data


def parse_vic3d(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize]:
    """Read a VIC-3D project or calibration file of two cameras.

    Returns
    -------
    tuple
        The pair (system frame = its camera 0) and the image size (width, height) of a project's area of interest, None
        if the file has none.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_unsupported``, ``calibration_invalid``.
    """
    try:
        root = read_side_by_side(data)  # some of its versions write the mask after the calibration
    except ValueError as error:
        raise unreadable(name, f"damaged XML, {error}") from error
    parts = list(root.iter("calibration"))
    if len(parts) != 1:
        raise unreadable(name, f"it has {len(parts)} calibrations")
    cameras = parts[0].findall("camera")
    if len(cameras) != 2:
        raise unsupported(name, f"it has {len(cameras)} cameras; a pair has two")
    ids = [camera.get("id", str(k)) for k, camera in enumerate(cameras)]
    if len(set(ids)) != 2:
        raise unreadable(name, f"both cameras have the id {ids[0]}")
    (lens1, pose1), (lens2, pose2) = (
        _camera(camera, f"camera {camera_id}", name) for camera_id, camera in sorted(zip(ids, cameras, strict=True))
    )
    relative = pose2 @ pose1.inverse()
    return pair_of(name, lens1, lens2, relative.rotation, relative.translation_mm), _image_size(root)


def _numbers(text: str | None, entry: str, name: str) -> list[float]:
    try:
        numbers = [float(part) for part in (text or "").split()]
    except ValueError as error:
        raise unreadable(name, f"{entry} holds {text!r}, not numbers") from error
    if not np.isfinite(numbers).all():
        raise invalid(name, f"{entry} holds a number that is not finite")
    return numbers


def _camera(camera: Element, where: str, name: str) -> tuple[OpenCVLens, RigidTransform]:
    orientation = camera.find("orientation")
    pose = _numbers(None if orientation is None else orientation.text, f"the orientation of {where}", name)
    if len(pose) != 6:
        raise unreadable(name, f"the orientation of {where} has {len(pose)} numbers, not 6")
    inner, bent = camera.find("intrinsics"), camera.find("distortion")
    if inner is not None:
        numbers = _numbers(inner.text, f"the intrinsics of {where}", name)
        if len(numbers) != len(_INTRINSICS):
            raise unreadable(name, f"the intrinsics of {where} have {len(numbers)} numbers, not {len(_INTRINSICS)}")
        numbers += _numbers(None if bent is None else bent.text, f"the distortion of {where}", name)
    else:
        numbers = _numbers(camera.text, where, name)
        if len(numbers) < len(_INTRINSICS):
            raise unreadable(name, f"{where} has {len(numbers)} numbers, not cx cy fx fy skew k1 k2 k3")
    names = (*_INTRINSICS, *_DISTORTION)
    if any(numbers[len(names) :]):
        raise unsupported(name, f"{where} has more lens terms than k1 k2 k3")
    lens = opencv_lens(name, where, dict(zip(names, numbers, strict=False)))
    return lens, RigidTransform(euler_zyx(*pose[:3]), np.array(pose[3:]))


def _image_size(root: Element) -> ImageSize:
    sizes = set()
    for mask in root.iter("polygonmask"):
        width, height = mask.get("width", ""), mask.get("height", "")
        if _SIZE.fullmatch(width) and _SIZE.fullmatch(height):
            sizes.add((int(width), int(height)))
    return sizes.pop() if len(sizes) == 1 else None


def vic3d_text(lens1: OpenCVLens, lens2: OpenCVLens, pair: StereoPair, comment: str) -> str:
    """Return a calibration as VIC-3D writes it: the world's origin between the cameras, X along the baseline.

    Y goes up in the image and Z towards the cameras.
    """
    cameras = []
    for k, (lens, pose) in enumerate(zip((lens1, lens2), _from_world(pair), strict=True)):
        numbers = (lens.cx_px, lens.cy_px, lens.fx_px, lens.fy_px, lens.skew_px, lens.k1, lens.k2, lens.k3)
        angles = [*euler_zyx_deg(pose.rotation), *pose.translation_mm.tolist()]
        cameras.append(
            f'  <camera id="{k}">{" ".join(map(repr, numbers))}<orientation>{" ".join(map(repr, angles))}'
            "</orientation>\n  </camera>\n"
        )
    safe = comment.replace("--", "- -")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- {safe} -->\n<project>\n <calibration lri="calibration">\n'
        f"{''.join(cameras)} </calibration>\n</project>\n"
    )


def _from_world(pair: StereoPair) -> tuple[RigidTransform, RigidTransform]:
    relative = pair.cam2_from_cam1
    centre2: Float = relative.inverse().translation_mm  # camera 1's frame from here
    axis = np.array([0.0, 0.0, 1.0]) + relative.rotation[2]
    x = -centre2 / np.linalg.norm(centre2)  # from the second camera to the first
    z = -axis + x * (axis @ x)
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)  # cam1_from_world
    first = RigidTransform(rotation, 0.5 * centre2)
    return first, relative @ first
