"""OpenCV stereo calibrations: ``cameraMatrix1/2, distCoeffs1/2, R, T, imageSize`` in YAML, JSON or XML.

As ``cv2.stereoCalibrate`` returns them: ``X_cam2 = R X_cam1 + T``. Matrices may be OpenCV's own (``!!opencv-matrix``)
or plain nested lists. The lens model here ends at k6: longer coefficient vectors are taken if thin prism and tilt are
zero.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from core.cameras.lens import OpenCVLens
from core.cameras.stereo import StereoPair
from server.formats.calibrations.programs.imported_pair import (
    ImageSize,
    invalid,
    opencv_lens,
    pair_of,
    unreadable,
    unsupported,
)

KEYS = ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2", "R", "T")
_LENGTHS = (4, 5, 8, 12, 14)
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_CARRIED = {5: _ORDER[:5], 8: _ORDER[:8]}
_MAX_NUMBERS = 100
_MAX_BYTES = 1 << 20  # a calibration is some kilobytes


def is_opencv(data: bytes) -> bool:
    """Return True if the bytes name OpenCV's stereo parameters."""
    return b"cameraMatrix1" in data[:_MAX_BYTES]


class _Loader(yaml.SafeLoader):
    """Plain YAML, and OpenCV's matrices as the mappings they are."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _matrix)


def _load(name: str, text: str) -> dict[str, object]:
    """Read YAML, JSON or XML text to plain lists, mappings and numbers."""
    try:
        if text.lstrip().startswith("<"):
            return _load_xml(text)
        # OpenCV's own first line, %YAML:1.0, is not the directive of YAML
        lines = [line for line in text.splitlines(keepends=True) if not line.startswith("%YAML")]
        content = yaml.load("".join(lines), Loader=_Loader)
    except (yaml.YAMLError, cv2.error, SystemError, ValueError, RecursionError) as error:
        raise unreadable(name, f"it is damaged ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise unreadable(name, "it names no values")
    return content


def _load_xml(text: str) -> dict[str, object]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    try:
        nodes = {key: storage.getNode(key) for key in (*KEYS, "imageSize")}
        return {key: _plain(node) for key, node in nodes.items() if not node.isNone()}
    finally:
        storage.release()


def _plain(node: Any) -> Any:
    if node.isReal() or node.isInt():
        return node.real()
    if node.isSeq():
        return [_plain(node.at(i)) for i in range(node.size())]
    return node.mat().tolist() if node.isMap() else node.string()


def _number(value: Any) -> float:
    if isinstance(value, bool) or value is None:
        raise ValueError("not a number")
    if isinstance(value, str):  # YAML 1.1 takes 1e-5 and .Nan for text
        value = value.strip().lower().replace(".nan", "nan").replace(".inf", "inf")
    return float(value)


def _flat(value: Any, depth: int = 0) -> list[float]:
    if not isinstance(value, list):
        return [_number(value)]
    if depth > 2 or len(value) > _MAX_NUMBERS:
        raise ValueError("nested too deeply or too long")
    return [number for part in value for number in _flat(part, depth + 1)]


def _array(name: str, content: dict[str, object], key: str) -> NDArray[np.float64]:
    if content.get(key) is None:
        raise unreadable(name, f"{key} is missing")
    value = content[key]
    try:
        if isinstance(value, dict):
            shape = value["sizes"] if "sizes" in value else [value["rows"], value["cols"]]
            array = np.reshape(_flat(value["data"]), [int(n) for n in shape])
        else:
            rows = len(value) if isinstance(value, list) and value and isinstance(value[0], list) else None
            array = np.array(_flat(value))
            array = array if rows is None else array.reshape(rows, -1)
    except (ValueError, TypeError, KeyError) as error:
        raise unreadable(name, f"{key} is not a matrix of numbers") from error
    if not np.isfinite(array).all():
        raise invalid(name, f"{key} holds a number that is not finite")
    return array


def _lens(name: str, content: dict[str, object], which: int) -> OpenCVLens:
    K = _array(name, content, f"cameraMatrix{which}")
    if K.shape != (3, 3):
        raise unreadable(name, f"cameraMatrix{which} has the shape {K.shape}, not (3, 3)")
    if K[1, 0] != 0.0 or K[2, 0] != 0.0 or K[2, 1] != 0.0 or K[2, 2] != 1.0:
        raise invalid(name, f"cameraMatrix{which} is not of the form [fx s cx; 0 fy cy; 0 0 1]")
    d = _array(name, content, f"distCoeffs{which}").ravel()
    if d.size not in _LENGTHS:
        raise unreadable(name, f"distCoeffs{which} has {d.size} values; OpenCV has {_LENGTHS}")
    other = [f"{term} = {value:g}" for term, value in zip(_ORDER[8:], d[8:], strict=False) if value != 0.0]
    if other:
        raise unsupported(
            name, f"distCoeffs{which} has {', '.join(other)}; thin prism (s1 to s4) and tilt (tau) are not known here"
        )
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": K[0, 1]}
    values.update(zip(_CARRIED[8], d[:8], strict=False))
    return opencv_lens(name, f"camera {which}", {k: float(v) for k, v in values.items()})


def parse_opencv(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize]:
    """Read an OpenCV stereo calibration.

    Returns
    -------
    tuple
        The pair (system frame = camera 1) and the image size (width, height), None where the file has none.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_unsupported`` or ``calibration_invalid``.
    """
    if len(data) > _MAX_BYTES:
        raise unreadable(name, f"it has {len(data)} bytes, far more than a calibration")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(name, "it is not text") from error
    content = _load(name, text)
    lens1, lens2 = _lens(name, content, 1), _lens(name, content, 2)
    pair = pair_of(name, lens1, lens2, _array(name, content, "R"), _array(name, content, "T"))
    if content.get("imageSize") is None:
        return pair, None
    size = _array(name, content, "imageSize").ravel()
    if size.size != 2 or size.min() < 1 or np.any(size % 1):
        raise invalid(name, f"imageSize is {size.tolist()}, not (width, height)")
    return pair, (int(size[0]), int(size[1]))


def opencv_text(
    lens1: OpenCVLens,
    lens2: OpenCVLens,
    pair: StereoPair,
    sizes: tuple[tuple[int, int], tuple[int, int]] | None,
    comment: str,
) -> str:
    """Return a stereo calibration as ``cv2.FileStorage`` reads it; the skew, which OpenCV does not have, must be 0.

    The image size is given where both cameras share one. A lens has five coefficients, eight where k4, k5 or k6 is not
    zero.
    """
    pose = pair.cam2_from_cam1
    lines = ["%YAML:1.0", "---", f"# {comment}"]
    if sizes is not None and sizes[0] == sizes[1]:
        lines.append(f"imageSize: [ {sizes[0][0]}, {sizes[0][1]} ]")
    for k, lens in enumerate((lens1, lens2), 1):
        matrix = [[lens.fx_px, lens.skew_px, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
        lines += _text_of(f"cameraMatrix{k}", np.array(matrix))
        terms = _CARRIED[8 if lens.is_rational else 5]
        lines += _text_of(f"distCoeffs{k}", np.array([[getattr(lens, term) for term in terms]]))
    lines += _text_of("R", pose.rotation) + _text_of("T", pose.translation_mm.reshape(3, 1))
    return "\n".join(lines) + "\n"


def _text_of(name: str, matrix: NDArray[np.float64]) -> list[str]:
    numbers = ", ".join(f"{v:.17g}" if v % 1 else f"{v:.0f}." for v in matrix.ravel())
    rows, cols = matrix.shape
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d", f"   data: [ {numbers} ]"]
