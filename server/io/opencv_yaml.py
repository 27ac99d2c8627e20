"""OpenCV stereo calibrations: ``cameraMatrix1/2, distCoeffs1/2, R, T, imageSize`` in YAML, JSON or XML.

As ``cv2.stereoCalibrate`` returns them: ``X_cam2 = R X_cam1 + T``. Matrices may be OpenCV's own (``!!opencv-matrix``)
or plain nested lists. The lens model here ends at k3: longer coefficient vectors are taken if the rest is zero.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.lens import OpenCVLens
from core.stereo import StereoPair
from server.io.imported_pair import invalid, opencv_lens, pair_of, unreadable, unsupported

ImageSize = tuple[int, int] | None

KEYS = ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2", "R", "T")
_LENGTHS = (4, 5, 8, 12, 14)
_ORDER = ("k1", "k2", "p1", "p2", "k3")
_MAX_BYTES = 1 << 20  # a calibration is some kilobytes


def looks_like_opencv(data: bytes) -> bool:
    """Tell whether the bytes name OpenCV's stereo parameters."""
    return b"cameraMatrix1" in data[:_MAX_BYTES]


def _values(node: Any) -> Any:
    """Turn a file node into numbers: nested lists for sequences, an array for a matrix, None for what is neither."""
    if node.isReal() or node.isInt():
        return node.real()
    if node.isSeq():
        return [_values(node.at(i)) for i in range(node.size())]
    if node.isMap():
        if not node.getNode("dt").isNone():
            return node.mat()
        rows, cols, data = node.getNode("rows"), node.getNode("cols"), node.getNode("data")
        if not (rows.isNone() or cols.isNone() or data.isNone()):
            return np.reshape(np.asarray(_values(data), dtype=np.float64), (int(rows.real()), int(cols.real())))
    return None


def _array(name: str, storage: Any, key: str) -> NDArray[np.float64]:
    node = storage.getNode(key)
    if node.isNone():
        raise unreadable(name, f"{key} is missing")
    try:
        array = np.asarray(_values(node), dtype=np.float64)
    except (ValueError, TypeError, cv2.error) as error:
        raise unreadable(name, f"{key} is not a matrix of numbers") from error
    if array.ndim == 0 and np.isnan(array):
        raise unreadable(name, f"{key} is not a matrix of numbers")
    if not np.isfinite(array).all():
        raise invalid(name, f"{key} holds a number that is not finite")
    return array


def _lens(name: str, storage: Any, which: int) -> OpenCVLens:
    K = _array(name, storage, f"cameraMatrix{which}")
    if K.shape != (3, 3):
        raise unreadable(name, f"cameraMatrix{which} has the shape {K.shape}, not (3, 3)")
    if K[1, 0] != 0.0 or K[2, 0] != 0.0 or K[2, 1] != 0.0 or K[2, 2] != 1.0:
        raise invalid(name, f"cameraMatrix{which} is not of the form [fx s cx; 0 fy cy; 0 0 1]")
    d = _array(name, storage, f"distCoeffs{which}").ravel()
    if d.size not in _LENGTHS:
        raise unreadable(name, f"distCoeffs{which} has {d.size} values; OpenCV has {_LENGTHS}")
    if np.any(d[5:]):
        raise unsupported(name, f"distCoeffs{which} has terms beyond k3 (rational, thin prism or tilt)")
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": K[0, 1]}
    values.update(zip(_ORDER, d[:5], strict=False))
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
    if not text.lstrip().startswith(("%YAML", "{", "<?xml")):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---\n")  # plain YAML, which OpenCV asks to be announced
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise unreadable(name, "OpenCV's reader finds it damaged") from error
    try:
        lens1, lens2 = _lens(name, storage, 1), _lens(name, storage, 2)
        pair = pair_of(name, lens1, lens2, _array(name, storage, "R"), _array(name, storage, "T"))
        size: ImageSize = None
        if not storage.getNode("imageSize").isNone():
            numbers = _array(name, storage, "imageSize").ravel()
            if numbers.size != 2 or numbers.min() < 1 or np.any(numbers % 1):
                raise invalid(name, f"imageSize is {numbers.tolist()}, not (width, height)")
            size = (int(numbers[0]), int(numbers[1]))
    finally:
        storage.release()
    return pair, size
