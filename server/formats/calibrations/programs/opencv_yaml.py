"""OpenCV stereo calibrations: ``cameraMatrix1/2, distCoeffs1/2, R, T, imageSize`` in YAML, JSON or XML.

As ``cv2.stereoCalibrate`` returns them: ``X_cam2 = R X_cam1 + T``. Matrices may be OpenCV's own (``!!opencv-matrix``)
or plain nested lists. OpenCV's own sample writes ``M1 D1 M2 D2`` and ``R T`` into two files, other programs ``K1`` or
``mtx_left``. A text may hold several documents, which count as one.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml
from numpy.typing import NDArray

from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import FileFormatError
from stereorig.server.formats.calibrations.programs.imported_pair import (
    LENGTHS_MM,
    MAX_SIDE_PX,
    ImageSize,
    invalid,
    opencv_lens,
    pair_of,
    unreadable,
    unsupported,
)
from stereorig.server.formats.xml_tree import read_side_by_side

_LENGTHS = (4, 5, 8, 12, 14)
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_MAX_NUMBERS = 100
_MAX_BYTES = 1 << 20  # a calibration is some kilobytes
_LENSES, _POSE = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"), ("R", "T")
_NEEDED = {*_LENSES, *_POSE}
#: without marks and capitals, but for single letters: k1 is a lens term, K1 a matrix
_MATRIX = ("M", "K", "cameramatrix", "intrinsicmatrix", "intrinsics", "mtx")
_BENT = ("D", "distcoeffs", "distcoeff", "distortioncoefficients", "distortion", "dist")
_SIDES = (("1", "L", "l", "left"), ("2", "R", "r", "right"))
_NAMES = {"rotation": "R", "rotationmatrix": "R", "translation": "T", "translationvector": "T", "t": "T"}
_NAMES |= {"imagesize": "imageSize", "imgsize": "imageSize", "imagewidth": "width", "imageheight": "height"}
for (_name, _stems), (_k, _sides) in itertools.product(
    (("cameraMatrix", _MATRIX), ("distCoeffs", _BENT)), enumerate(_SIDES, 1)
):
    _NAMES |= {
        spelled: f"{_name}{_k}"
        for stem, side in itertools.product(_stems, _sides)
        for spelled in (stem + side, side + stem)
    }
_ENTRY = re.compile(rb"\b([A-Za-z][A-Za-z0-9_-]{0,40})[\"'>]?\s{0,9}[:>]")


_UNITS = ("unit", "units", "lengthunit", "unitoflength", "translationunit")
_UNIT_NAMES = {"meter": "m", "meters": "m", "metre": "m", "metres": "m", "millimeter": "mm", "millimeters": "mm"}
_UNIT_NAMES |= {"millimetre": "mm", "millimetres": "mm", "centimeter": "cm", "centimeters": "cm", "inch": "in"}
_MODELS = ("model", "cameramodel", "lensmodel", "distortionmodel", "distortiontype")
#: models of a lens that have other terms under the same names
_OTHER_MODELS = {
    "fisheye",
    "equidistant",
    "equi",
    "kannala",
    "omni",
    "omnidirectional",
    "ucm",
    "eucm",
    "division",
    "fov",
}


class _TwiceError(yaml.YAMLError):
    """A key that occurs twice."""


class _OnceLoader(yaml.BaseLoader):
    """Refuses a mapping that has a key twice: the last one would be taken without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping whose keys are all different."""
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if any(count > 1 for count in keys.values()):
            raise _TwiceError(keys.most_common(1)[0][0])
        return super().construct_mapping(node, deep)


def is_opencv(data: bytes) -> bool:
    """Return True if the bytes name OpenCV's stereo parameters, or half of them in its own notation."""
    named = {_plain_name(entry.decode()) for entry in _ENTRY.findall(data[:_MAX_BYTES])}
    return "cameraMatrix1" in named or (b"opencv" in data[:_MAX_BYTES] and named >= {*_POSE})


def joined(data: bytes, other: bytes) -> bytes:
    """Return the text of both halves."""
    return data + (b"\n" if data.lstrip()[:1] == b"<" else b"\n---\n") + other


def is_half(data: bytes) -> bool:
    """Return True if the bytes are OpenCV's lenses without the pose between them, or the pose alone."""
    if not is_opencv(data):
        return False
    try:
        content = _load("", data.decode("utf-8-sig"))
    except (UnicodeDecodeError, FileFormatError):
        return False
    return _lacking(content) != ""


def _lacking(content: dict[str, object]) -> str:
    """Return the half that a text does not have at all: ``M1 D1 M2 D2`` or ``R T``; empty for both or neither."""
    lenses, pose = ({*names} & content.keys() for names in (_LENSES, _POSE))
    return "" if bool(lenses) == bool(pose) else "R T" if lenses else "M1 D1 M2 D2"


def _plain_name(name: str) -> str:
    """Return OpenCV's documented name of an entry, for one that is known under another; else the name."""
    plain = re.sub(r"[-_ ]", "", name)
    return _NAMES.get(plain) or _NAMES.get(plain.lower() if len(plain) > 2 else "", name)


def _load(name: str, text: str) -> dict[str, object]:
    """Read YAML, JSON or XML text to plain lists, mappings and texts, by OpenCV's documented names."""
    try:
        if text.lstrip().startswith("<"):
            stored = read_side_by_side(text.encode())
            pairs = [(child.tag, _plain(child)) for part in stored for child in part]
        else:
            # OpenCV's own first line, %YAML:1.0, is not the directive of YAML
            lines = [line for line in text.splitlines(keepends=True) if not line.startswith("%YAML")]
            # every scalar stays a text, every tag unknown: nothing is made of them but lists, mappings and texts
            documents = [one for one in yaml.load_all("".join(lines), Loader=_OnceLoader) if one]
            if not all(isinstance(one, dict) for one in documents):
                raise unreadable(name, "it names no values")
            pairs = [pair for one in documents for pair in one.items()]
    except _TwiceError as error:
        raise unreadable(name, f"{str(error)[:40]} occurs twice in it") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise unreadable(name, f"it is damaged ({type(error).__name__})") from error
    stated: dict[str, object] = {key: value for key, value in pairs if isinstance(key, str)}
    other = next((key for key, value in pairs if stated.get(key) != value and _plain_name(key) in _NEEDED), None)
    if other is not None:
        raise unreadable(name, f"it has two values of {other}")
    content = dict(stated)
    for key, value in stated.items():
        plain = _plain_name(key)
        if content.setdefault(plain, value) != value and plain not in stated:
            raise unreadable(name, f"it has two values of {plain}, one of them {key}")
    return content


def _plain(element: Element) -> Any:
    """Return an element of OpenCV's XML as YAML would give it: a matrix, a mapping, a list or a number."""
    if not len(element):
        words = (element.text or "").split()
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in element):
        return [_plain(child) for child in element]
    found = {child.tag: _plain(child) for child in element}
    if found.get("dt") == "f":  # OpenCV keeps these numbers in 32 bit
        found["data"] = [float(np.float32(_number(number))) for number in found.get("data", [])]
    return found


def _number(value: Any) -> float:
    if not isinstance(value, str | float) or not str(value).isascii():  # other scripts' digits are no notation here
        raise ValueError("not a number")
    return float(str(value).strip().lower().replace(".nan", "nan").replace(".inf", "inf"))


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
            sizes = _flat(value["sizes"] if "sizes" in value else [value["rows"], value["cols"]])
            numbers = _flat(value["data"])
            if math.prod(sizes) != len(numbers) or min(sizes) < 1 or any(size % 1 for size in sizes):
                raise ValueError("numbers and sizes disagree")
            array = np.reshape(numbers, [int(size) for size in sizes])
        else:
            rows = len(value) if isinstance(value, list) and value and isinstance(value[0], list) else None
            array = np.array(_flat(value))
            array = array if rows is None else array.reshape(rows, -1)
    except (ValueError, KeyError) as error:
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
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": K[0, 1]}
    values.update(zip(_ORDER, d, strict=False))
    return opencv_lens(name, f"camera {which}", {k: float(v) for k, v in values.items()})


def _stated(content: dict[str, object], keys: tuple[str, ...]) -> str:
    """Return the text of an entry under any of these names; empty for none."""
    found = (value for key, value in content.items() if re.sub("[-_ ]", "", key).lower() in keys)
    return next((value.strip().lower() for value in found if isinstance(value, str)), "")


def _require_known_lens(content: dict[str, object], name: str) -> None:
    model = _stated(content, _MODELS)
    if _stated(content, ("fisheye", "isfisheye")) in ("1", "true", "yes"):
        model = "fisheye"
    if _OTHER_MODELS.intersection(re.findall("[a-z]+", model)):
        raise unsupported(
            name, f"its lenses are of the model {model[:40]!r}, whose terms are others than OpenCV's k1, k2"
        )


def parse_opencv(data: bytes, *, name: str) -> tuple[StereoPair, ImageSize, str | None]:
    """Read an OpenCV stereo calibration.

    Returns
    -------
    tuple
        The pair (system frame = camera 1), its lengths taken for millimetres; the image size (width, height), None
        where the file has none; the unit of length that it states.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable``, ``calibration_invalid`` or ``calibration_unsupported``.
    """
    if len(data) > _MAX_BYTES:
        raise unreadable(name, f"it has {len(data)} bytes, far more than a calibration")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(name, "it is not text") from error
    content = _load(name, text)
    lacks = _lacking(content)
    if lacks:
        has = "M1 D1 M2 D2" if lacks == "R T" else "R T"
        raise unreadable(
            name,
            f"it is the one of OpenCV's two files that has {has}; {lacks} are in the other",
            remedy="Append the other file's text to this one, and give that; a command also finds the other file if "
            "both are in one folder as intrinsics.yml and extrinsics.yml.",
        )
    _require_known_lens(content, name)
    named = _stated(content, _UNITS)
    unit = _UNIT_NAMES.get(named, named if named in LENGTHS_MM else None)
    lens1, lens2 = _lens(name, content, 1), _lens(name, content, 2)
    pair = pair_of(name, lens1, lens2, _array(name, content, "R"), _array(name, content, "T"))
    if {"width", "height"} <= content.keys():
        content.setdefault("imageSize", [content["width"], content["height"]])
    if content.get("imageSize") is None:
        return pair, None, unit
    size = _array(name, content, "imageSize").ravel()
    if size.size != 2 or size.min() < 1 or size.max() > MAX_SIDE_PX or np.any(size % 1):
        raise invalid(name, f"imageSize is {size.tolist()}, not (width, height)")
    return pair, (int(size[0]), int(size[1])), unit


def opencv_text(
    lens1: OpenCVLens,
    lens2: OpenCVLens,
    pair: StereoPair,
    sizes: tuple[tuple[int, int], tuple[int, int]] | None,
    comment: str,
) -> str:
    """Return a stereo calibration as ``cv2.FileStorage`` reads it; the skew, which OpenCV does not have, must be 0.

    The image size is given where both cameras share one. A lens has five coefficients, eight where k4, k5 or k6 is not
    zero, twelve with a thin prism, fourteen on a tilted sensor.
    """
    pose = pair.cam2_from_cam1
    lines = ["%YAML:1.0", "---", f"# {comment}"]
    if sizes is not None and sizes[0] == sizes[1]:
        lines.append(f"imageSize: [ {sizes[0][0]}, {sizes[0][1]} ]")
    for k, lens in enumerate((lens1, lens2), 1):
        matrix = [[lens.fx_px, lens.skew_px, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
        lines += _text_of(f"cameraMatrix{k}", np.array(matrix))
        values = [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6]
        values += lens.prism.values() if isinstance(lens, OpenCVFullLens) else []
        n = next(n for n in _LENGTHS[1:] if not any(values[n:]))
        lines += _text_of(f"distCoeffs{k}", np.array([values[:n]]))
    lines += _text_of("R", pose.rotation) + _text_of("T", pose.translation_mm.reshape(3, 1))
    return "\n".join(lines) + "\n"


def _text_of(name: str, matrix: NDArray[np.float64]) -> list[str]:
    numbers = ", ".join(f"{v:.17g}" if v % 1 else f"{v:.0f}." for v in matrix.ravel())
    rows, cols = matrix.shape
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d", f"   data: [ {numbers} ]"]
