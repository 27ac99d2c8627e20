"""The Aravis library, loaded when it is first needed, and its errors as the project's.

PyGObject has no types and is in the extra ``[aravis]`` only: nothing else in the project imports it.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import CameraError

_VERSIONS = {"Aravis": "0.8", "GLib": "2.0", "GIRepository": "2.0"}
_INSTALL = (
    "Install the bindings: apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc "
    "python3-dev, then pip install 'stereorig[aravis]'."
)


def aravis() -> Any:
    """Return the namespace of Aravis 0.8.

    Raises
    ------
    CameraError
        ``driver_missing`` when PyGObject or Aravis is not installed.
    """
    return repository().Aravis


def glib_error() -> type[Exception]:
    """Return the class of the errors that Aravis raises."""
    error: type[Exception] = repository().GLib.Error
    return error


def text_of(call: Callable[[], Any]) -> str:
    """Return the text that a function of Aravis gives, empty if none; a maker may have written it in any encoding."""
    try:
        return str(call() or "")
    except UnicodeDecodeError as error:  # GLib's texts should be UTF-8
        return error.object.decode("latin-1")


@functools.cache
def repository() -> Any:
    """Return the package of Aravis and of the libraries that it needs."""
    try:
        import gi

        for name, version in _VERSIONS.items():
            gi.require_version(name, version)
        import gi.repository.Aravis
        import gi.repository.GIRepository
        import gi.repository.GLib
    except (ImportError, ValueError) as error:  # ValueError: PyGObject is there, the library is not
        raise CameraError(
            f"The Aravis library cannot be used: {error}.", code="driver_missing", remedy=_INSTALL
        ) from error
    return gi.repository


def buffer_bytes(buffer: Any) -> NDArray[np.uint8]:
    """Return the bytes that came into a buffer, not copied: they are good until the buffer is given back."""
    size = ctypes.c_size_t()
    address = _data_of()(_pointer(buffer), ctypes.byref(size))
    if not address or not size.value:
        return np.empty(0, np.uint8)
    memory = (ctypes.c_uint8 * size.value).from_address(address)
    return np.ctypeslib.as_array(memory)


@functools.cache
def _data_of() -> Any:
    # PyGObject's own get_data() copies every frame into a bytes object first
    libraries = repository().GIRepository.Repository.get_default()
    library = ctypes.CDLL(libraries.get_shared_library("Aravis").split(",")[0])
    function = library.arv_buffer_get_data
    function.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    function.restype = ctypes.c_void_p
    return function


def _pointer(gobject: Any) -> int:
    capsule = ctypes.pythonapi.PyCapsule_GetPointer
    capsule.argtypes = [ctypes.py_object, ctypes.c_char_p]
    capsule.restype = ctypes.c_void_p
    pointer: int = capsule(gobject.__gpointer__, None)
    return pointer
