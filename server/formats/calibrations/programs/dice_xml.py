"""DICe's XML camera system files.

DICe counts cameras from 0: its camera 0 is camera 1 here. With ``extrinsics_relative_camera_to_camera`` the second
camera's matrix and TX TY TZ are ``X_cam1 = R X_cam0 + T``, else each camera's are ``X_cam = R X_world + T``. Euler
angles are degrees with R = Rz(gamma) Ry(beta) Rx(alpha) (the comment that DICe writes next to a matrix has them in
radians).

Three lens models are read: OpenCV's, none, and ``K1R3_K2R5_K3R7``, the same as OpenCV's k1 k2 k3. A system of type
VIC3D holds VIC-3D's numbers: its lens is read as VIC-3D's own files are, with the skew in pixels; DICe itself only
guesses that polynomial. The file does not define the other models, nor FS in pixels outside these models.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.camera import RigidTransform
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
from stereorig.server.formats.xml_tree import read_xml

VIC3D_NOTE = (
    "the lens was taken as VIC-3D's, 1 + k1 r^2 + k2 r^4 + k3 r^6, from which its numbers come; DICe itself reads them "
    "in another way: check the calibration with points that it has measured"
)
_VIC3D = "VIC3D"
_SYSTEMS = ("OPENCV", "GENERIC_SYSTEM", _VIC3D)
_OPENCV_LENSES = ("OPENCV_LENS_DISTORTION", "OPENCV_DIS")
_NO_LENSES = ("NO_LENS_DISTORTION", "NONE")
_RADIAL_LENS = "K1R3_K2R5_K3R7"
_VIC3D_LENSES = ("VIC3D_LENS_DISTORTION", "VIC3D_DIS", "K1R1_K2R2_K3R3")  # of a system of type VIC3D
_DISTORTION = ("K1", "K2", "K3", "P1", "P2")
_RATIONAL = ("K4", "K5", "K6")  # read, not written
_NOT_CARRIED = ("S1", "S2", "S3", "S4", "T1", "T2")


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
        return euler_zyx(*(_number(name, where, key, values) for key in ("ALPHA", "BETA", "GAMMA")))
    rows = _parameters(name, f"the rotation of {where}", matrices[0])
    if set(rows) != {"ROW 0", "ROW 1", "ROW 2"}:
        raise unreadable(name, f"the rotation of {where} has the rows {sorted(rows)}")
    R = [_row(name, f"ROW {i} of {where}", rows[f"ROW {i}"], 3) for i in range(3)]
    return proper_rotation(name, f"the rotation of {where}", R)


def _camera(name: str, camera: Element, system: str) -> tuple[OpenCVLens, RigidTransform, ImageSize]:
    where = str(camera.get("name"))
    values = _parameters(name, where, camera)
    model = values.get("LENS_DISTORTION_MODEL", "NONE")
    known = (*_OPENCV_LENSES, *_NO_LENSES, _RADIAL_LENS, *(_VIC3D_LENSES if system == _VIC3D else ()))
    if model not in known:
        raise unsupported(name, f"{where} has the lens model {model}; {', '.join(known)} are known")
    radial = model == _RADIAL_LENS or model in _VIC3D_LENSES
    others = (*_RATIONAL, "P1", "P2") if radial else ()
    for key in (*(() if system == _VIC3D else ("FS",)), *_NOT_CARRIED, *others):
        if _number(name, where, key, values) != 0.0:
            raise unsupported(name, f"{where} has {key} = {values[key]}, which its lens model here does not have")
    numbers = {key.lower(): _number(name, where, key, values, None) for key in ("FX", "FY", "CX", "CY")}
    distortion = {key.lower(): _number(name, where, key, values) for key in (*_DISTORTION, *_RATIONAL)}
    if model in _NO_LENSES and any(distortion.values()):
        raise unsupported(name, f"{where} has distortion coefficients but the lens model {model}")
    numbers["skew"] = _number(name, where, "FS", values)
    pose = RigidTransform(
        _rotation(name, where, camera, values),
        np.array([_number(name, where, key, values) for key in ("TX", "TY", "TZ")]),
    )
    size: ImageSize = None
    if "IMAGE_HEIGHT_WIDTH" in values:
        height, width = _row(name, f"IMAGE_HEIGHT_WIDTH of {where}", values["IMAGE_HEIGHT_WIDTH"], 2)
        if 0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX:  # DICe writes -1 for "not known"
            size = (int(width), int(height))
    return opencv_lens(name, where, {**numbers, **distortion}), pose, size


def parse_dice_xml(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize, ImageSize, tuple[str, ...]]:
    """Read a DICe camera system of two cameras.

    Returns
    -------
    tuple
        The pair (system frame = its camera 0), both image sizes (width, height), None if the file has none, and
        notes on the assumptions made.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_unsupported`` (another system type or lens model) or
        ``calibration_invalid`` (numbers that describe no cameras).
    """
    try:
        root = read_xml(data)
    except ValueError as error:
        raise unreadable(name, f"damaged XML, {error}") from error
    top = _parameters(name, "the file", root)
    if root.tag != "ParameterList" or top.get("xml_file_format") != "DICe_xml_camera_system_file":
        raise unreadable(name, "it is XML, but no DICe_xml_camera_system_file")
    system = top.get("system_type_3D", "none given")
    if system not in _SYSTEMS:
        raise unsupported(name, f"its system type is {system}; {', '.join(_SYSTEMS)} are known")
    cameras = {str(c.get("name")): c for c in root.findall("ParameterList") if str(c.get("name")).startswith("CAMERA")}
    if set(cameras) != {"CAMERA 0", "CAMERA 1"}:
        raise unsupported(name, f"it has the cameras {sorted(cameras)}; a pair has CAMERA 0 and CAMERA 1")
    lens1, pose1, size1 = _camera(name, cameras["CAMERA 0"], system)
    lens2, pose2, size2 = _camera(name, cameras["CAMERA 1"], system)
    relative = top.get("extrinsics_relative_camera_to_camera", "false").strip().lower() in ("true", "1")
    cam2_from_cam1 = pose2 if relative else pose2 @ pose1.inverse()
    bent = any(any((lens.k1, lens.k2, lens.k3)) for lens in (lens1, lens2))
    pair = pair_of(name, lens1, lens2, cam2_from_cam1.rotation, cam2_from_cam1.translation_mm)
    return pair, size1, size2, (VIC3D_NOTE,) if system == _VIC3D and bent else ()


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
