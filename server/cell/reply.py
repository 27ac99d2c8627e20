"""Replies of the readers to the service: plain values as JSON, arrays as their bytes; nothing that runs.

The service trusts no byte of it: the process that wrote it read a foreign file.
"""

from __future__ import annotations

import errno
import functools
import json
import math
import mmap
import struct
import traceback
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

import stereorig.core.errors
from stereorig.core.errors import CalibrationError, InputError, StereorigError
from stereorig.server.base.errors import TooLargeError

_MAX_JSON_BYTES = 16 << 20
_MAX_DIMENSIONS = 4
_MAX_TEXT = 2000
_HEAD = struct.Struct("<Q")
#: how a child ended: status as of wait(2), processor time in us, and 1 if its time by the clock was over
ENDED = struct.Struct("<iqB")
_ALIGNED = 64
_ARRAY = "array"
_TYPES = {f"{order}{kind}" for order in "<|" for kind in ("b1", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8")}
_TYPES |= {"<f4", "<f8"}
_PROBLEMS = Path(__file__).resolve().parents[1] / "static" / "problems.json"


class BrokenReplyError(Exception):
    """A reply that no reader of this program writes."""


def write_value(out: BinaryIO, value: object) -> None:
    """Write a value: None, numbers, texts, lists, mappings by text, and arrays in them."""
    arrays: list[NDArray[Any]] = []
    _write(out, {"value": _plain(value, arrays)}, arrays)


def write_error(out: BinaryIO, error: BaseException) -> None:
    """Write an error in place of a value."""
    chain = [error]
    while (before := chain[-1].__cause__ or chain[-1].__context__) is not None and before not in chain:
        chain.append(before)
    # a traceback's own text would open the sources
    way = [f"{frame.f_code.co_name}:{line}" for frame, line in traceback.walk_tb(error.__traceback__)]
    found: dict[str, object] = {"kind": type(error).__name__, "trace": f"{str(error)[:200]} in {' '.join(way[-20:])}"}
    if any(isinstance(one, MemoryError) or getattr(one, "errno", None) == errno.EFBIG for one in chain):
        found["memory"] = True
    elif isinstance(error, StereorigError):
        found |= {
            "kind": next((c.__name__ for c in type(error).__mro__ if c.__name__ in _kinds()), ""),
            "code": error.code,
            "cause": error.cause,
            "remedy": error.remedy,
        }
        found["context"] = {k: v for k, v in error.context.items() if isinstance(v, str | int | float | bool)}
    _write(out, {"error": found}, [])


def _write(out: BinaryIO, head: object, arrays: list[NDArray[Any]]) -> None:
    text = json.dumps(head).encode()
    at = _put(out, _HEAD.pack(len(text)) + text)
    for array in arrays:
        at += _put(out, bytes(-at % _ALIGNED))
        at += _put(out, array.reshape(-1).view(np.uint8).data)


def _put(out: BinaryIO, data: bytes | memoryview) -> int:
    left = memoryview(data)
    while left:
        left = left[out.write(left) :]
    return len(data)


def _plain(value: Any, arrays: list[NDArray[Any]]) -> object:
    if isinstance(value, np.ndarray):
        made = np.ascontiguousarray(value)
        arrays.append(made)
        return {_ARRAY: [made.dtype.str, *value.shape]}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        # one more level, which an array does not have
        return {"": {str(k): _plain(v, arrays) for k, v in value.items()}}
    if isinstance(value, list | tuple):
        return [_plain(v, arrays) for v in value]
    return value


def read_reply(reply: mmap.mmap) -> Any:
    """Return the value of a reply; its arrays are views of the map, and may be written to if that is a private one.

    Raises
    ------
    BrokenReplyError
        It is none.
    StereorigError
        The error that it holds in place of a value, of a known class and code; ``file_too_large`` for want of memory.
    """
    try:
        (length,) = _HEAD.unpack_from(reply)
        if length > _MAX_JSON_BYTES:
            raise TooLargeError("A file's content is too long to be read.", code="file_too_large", remedy="Send less.")
        head = json.loads(reply[_HEAD.size : _HEAD.size + length])
        if "error" in head:
            raise _error_of(head["error"])
        return _Reader(reply, _HEAD.size + length).value(head["value"])
    except (struct.error, ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise BrokenReplyError(f"{type(error).__name__}, {error}") from error


class _Reader:
    def __init__(self, reply: mmap.mmap, at: int) -> None:
        self._reply, self._at = reply, at

    def value(self, found: Any) -> Any:
        if isinstance(found, list):
            return [self.value(one) for one in found]
        if not isinstance(found, dict):
            return found
        if _ARRAY in found:
            return self._array(*found[_ARRAY])
        return {name: self.value(one) for name, one in found[""].items()}

    def _array(self, kind: str, *shape: int) -> NDArray[Any]:
        if kind not in _TYPES or len(shape) > _MAX_DIMENSIONS or not all(type(n) is int and n >= 0 for n in shape):
            raise ValueError(f"an array {kind!r} of {shape}")
        dtype, count = np.dtype(kind), math.prod(shape)
        begin = self._at + -self._at % _ALIGNED
        self._at = begin + count * dtype.itemsize
        if self._at > len(self._reply):
            raise ValueError("it was cut short")
        return np.frombuffer(self._reply, dtype, count, begin).reshape(shape) if count else np.zeros(shape, dtype)


def _error_of(found: dict[str, Any]) -> StereorigError | BrokenReplyError:
    if found.get("memory") is True:
        return TooLargeError(
            "The file's content takes more memory than its declared size allows.",
            code="file_too_large",
            remedy="Export it again, smaller; ask who sent it if it should be small.",
        )
    kind, code = _kinds().get(found["kind"]), found.get("code")
    if kind is None or code not in _known_codes():
        name = str(found["kind"])[:80]
        shown = f"{str(found.get('trace'))[:_MAX_TEXT]!r}"
        return BrokenReplyError(f"{name if name.isidentifier() else 'no error'}: {shown}")
    context = {str(k)[:80]: v for k, v in found["context"].items() if isinstance(v, str | int | float | bool)}
    context = {k: v for k, v in context.items() if k not in ("cause", "code", "remedy", "self")}
    return kind(str(found["cause"])[:_MAX_TEXT], code=code, remedy=str(found["remedy"])[:_MAX_TEXT], **context)


@functools.cache
def _kinds() -> dict[str, type[StereorigError]]:
    """Return the classes of the errors that a reader may raise, by name."""
    found = [
        one for one in vars(stereorig.core.errors).values() if isinstance(one, type) and issubclass(one, InputError)
    ]
    return {one.__name__: one for one in (*found, CalibrationError, TooLargeError)}


@functools.cache
def _known_codes() -> frozenset[str]:
    return frozenset(json.loads(_PROBLEMS.read_text(encoding="utf-8")))
