"""DICe's XML camera system files.

DICe counts cameras from 0: its camera 0 is camera 1 here. With ``extrinsics_relative_camera_to_camera`` the second
camera's matrix and TX TY TZ are ``X_cam1 = R X_cam0 + T``, else each camera's are ``X_cam = R X_world + T``. Euler
angles are radians with R = Rz(gamma) Ry(beta) Rx(alpha). Only OpenCV's lens (or none) is taken: what DICe's other
lens models mean in pixels is not written in the file.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException
from numpy.typing import NDArray

from core.cameras.camera import RigidTransform
from core.cameras.lens import OpenCVLens
from core.cameras.stereo import StereoPair
from server.formats.calibrations.imported_pair import (
    invalid,
    opencv_lens,
    pair_of,
    proper_rotation,
    unreadable,
    unsupported,
)

ImageSize = tuple[int, int] | None

_SYSTEMS = ("OPENCV", "GENERIC_SYSTEM")
_OPENCV_LENSES = ("OPENCV_LENS_DISTORTION", "OPENCV_DIS")
_NO_LENSES = ("NO_LENS_DISTORTION", "NONE")
_DISTORTION = ("K1", "K2", "K3", "P1", "P2")
_RATIONAL = ("K4", "K5", "K6")  # read, not written
_NOT_CARRIED = ("FS", "S1", "S2", "S3", "S4", "T1", "T2")


def is_dice(data: bytes) -> bool:
    """Return True if the bytes are an XML file of DICe's kind."""
    return b"<ParameterList" in data[:4096] and b"CAMERA" in data


def _parameters(name: str, where: str, element: Element) -> dict[str, str]:
    values: dict[str, str] = {}
    for parameter in element.findall("Parameter"):
        key, value = parameter.get("name"), parameter.get("value")
        if key is None or value is None:
            raise unreadable(name, f"a Parameter of {where} has no name or no value")
        if key in values:
            raise unreadable(name, f"{key} occurs twice in {where}")
        values[key] = value
    return values


def _number(name: str, where: str, key: str, values: dict[str, str], default: float | None = 0.0) -> float:
    text = values.get(key)
    if text is None:
        if default is None:
            raise unreadable(name, f"{key} of {where} is missing")
        return default
    try:
        number = float(text)
    except ValueError as error:
        raise unreadable(name, f"{key} of {where} is {text!r}, not a number") from error
    if not np.isfinite(number):
        raise invalid(name, f"{key} of {where} is {text}")
    return number


def _row(name: str, entry: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.strip().strip("{}").split(",")]
    except ValueError as error:
        raise unreadable(name, f"{entry} is {text!r}, not a row of numbers") from error
    if len(numbers) != count:
        raise unreadable(name, f"{entry} has {len(numbers)} numbers, not {count}")
    return numbers


def _rotation(name: str, where: str, camera: Element, values: dict[str, str]) -> NDArray[np.float64]:
    matrices = [m for m in camera.findall("ParameterList") if m.get("name") == "rotation_3x3_matrix"]
    angles = [key for key in ("ALPHA", "BETA", "GAMMA") if key in values]
    if len(matrices) > 1 or (matrices and angles):
        raise unreadable(name, f"the rotation of {where} is given more than once")
    if not matrices:
        a, b, g = (_number(name, where, key, values) for key in ("ALPHA", "BETA", "GAMMA"))
        ca, sa, cb, sb, cg, sg = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(g), np.sin(g)
        rz = np.array([[cg, -sg, 0.0], [sg, cg, 0.0], [0.0, 0.0, 1.0]])
        ry = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
        rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
        return np.asarray(rz @ ry @ rx)
    rows = _parameters(name, f"the rotation of {where}", matrices[0])
    if set(rows) != {"ROW 0", "ROW 1", "ROW 2"}:
        raise unreadable(name, f"the rotation of {where} has the rows {sorted(rows)}")
    R = [_row(name, f"ROW {i} of {where}", rows[f"ROW {i}"], 3) for i in range(3)]
    return proper_rotation(name, f"the rotation of {where}", R)


def _camera(name: str, camera: Element) -> tuple[OpenCVLens, RigidTransform, ImageSize]:
    where = str(camera.get("name"))
    values = _parameters(name, where, camera)
    model = values.get("LENS_DISTORTION_MODEL", "NONE")
    if model not in (*_OPENCV_LENSES, *_NO_LENSES):
        raise unsupported(name, f"{where} has the lens model {model}; only OPENCV_LENS_DISTORTION and NONE are known")
    for key in _NOT_CARRIED:
        if _number(name, where, key, values) != 0.0:
            raise unsupported(name, f"{where} has {key} = {values[key]}, which the lens model here does not have")
    numbers = {key.lower(): _number(name, where, key, values, None) for key in ("FX", "FY", "CX", "CY")}
    distortion = {key.lower(): _number(name, where, key, values) for key in (*_DISTORTION, *_RATIONAL)}
    if model in _NO_LENSES and any(distortion.values()):
        raise unsupported(name, f"{where} has distortion coefficients but the lens model {model}")
    pose = RigidTransform(
        _rotation(name, where, camera, values),
        np.array([_number(name, where, key, values) for key in ("TX", "TY", "TZ")]),
    )
    size: ImageSize = None
    if "IMAGE_HEIGHT_WIDTH" in values:
        height, width = _row(name, f"IMAGE_HEIGHT_WIDTH of {where}", values["IMAGE_HEIGHT_WIDTH"], 2)
        if width > 0 and height > 0:  # DICe writes -1 for "not known"
            size = (int(width), int(height))
    return opencv_lens(name, where, {**numbers, **distortion}), pose, size


def parse_dice_xml(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize, ImageSize]:
    """Read a DICe camera system of two cameras.

    Returns
    -------
    tuple
        The pair (system frame = its camera 0) and both image sizes (width, height), None where the file has none.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_unsupported`` (another system type or lens model) or
        ``calibration_invalid`` (numbers that describe no cameras).
    """
    try:
        root = defusedxml.ElementTree.fromstring(data)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise unreadable(name, f"damaged XML, {type(error).__name__} {error}") from error
    top = _parameters(name, "the file", root)
    if root.tag != "ParameterList" or top.get("xml_file_format") != "DICe_xml_camera_system_file":
        raise unreadable(name, "it is XML, but no DICe_xml_camera_system_file")
    system = top.get("system_type_3D", "none given")
    if system not in _SYSTEMS:
        raise unsupported(name, f"its system type is {system}; OPENCV and GENERIC_SYSTEM are known")
    cameras = {str(c.get("name")): c for c in root.findall("ParameterList") if str(c.get("name")).startswith("CAMERA")}
    if set(cameras) != {"CAMERA 0", "CAMERA 1"}:
        raise unsupported(name, f"it has the cameras {sorted(cameras)}; a pair has CAMERA 0 and CAMERA 1")
    lens1, pose1, size1 = _camera(name, cameras["CAMERA 0"])
    lens2, pose2, size2 = _camera(name, cameras["CAMERA 1"])
    relative = top.get("extrinsics_relative_camera_to_camera", "false").strip().lower() in ("true", "1")
    cam2_from_cam1 = pose2 if relative else pose2 @ pose1.inverse()
    return pair_of(name, lens1, lens2, cam2_from_cam1.rotation, cam2_from_cam1.translation_mm), size1, size2


def dice_text(
    lens1: OpenCVLens,
    lens2: OpenCVLens,
    pair: StereoPair,
    sizes: tuple[tuple[int, int], tuple[int, int]] | None,
    comment: str,
) -> str:
    """Return a camera system as DICe reads it; the skew must be 0, DICe's own is an angle or not, as one reads it."""
    safe = comment.replace("--", "- -")
    lines = [
        "<ParameterList>",
        f"<!-- {safe} -->",
        _parameter("xml_file_format", "DICe_xml_camera_system_file"),
        _parameter("system_type_3D", "OPENCV"),
        _parameter("extrinsics_relative_camera_to_camera", "true", "bool"),
    ]
    poses = (RigidTransform.identity(), pair.cam2_from_cam1)
    for k, (lens, pose) in enumerate(zip((lens1, lens2), poses, strict=True)):
        lines.append(f'<ParameterList name="CAMERA {k}">')
        numbers = {"CX": lens.cx_px, "CY": lens.cy_px, "FX": lens.fx_px, "FY": lens.fy_px}
        numbers |= {name: getattr(lens, name.lower()) for name in _DISTORTION}
        numbers |= dict(zip(("TX", "TY", "TZ"), pose.translation_mm.tolist(), strict=True))
        lines += [_parameter(name, repr(float(value)), "double") for name, value in numbers.items()]
        lines += [_parameter("LENS_DISTORTION_MODEL", _OPENCV_LENSES[0]), '<ParameterList name="rotation_3x3_matrix">']
        for i, row in enumerate(pose.rotation.tolist()):
            lines.append(_parameter(f"ROW {i}", "{ " + ", ".join(map(repr, row)) + " }"))
        lines.append("</ParameterList>")
        if sizes is not None:
            width, height = sizes[k]
            lines.append(_parameter("IMAGE_HEIGHT_WIDTH", f"{{ {height}, {width} }}"))
        lines.append("</ParameterList>")
    return "\n".join([*lines, "</ParameterList>"]) + "\n"


def _parameter(name: str, value: str, kind: str = "string") -> str:
    return f'<Parameter name="{name}" type="{kind}" value="{value}" />'
