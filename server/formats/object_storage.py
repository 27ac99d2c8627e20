"""Images in object storage: copied to the disk before they are measured, by fsspec and the user's own credentials.

Addresses are fsspec's, ``s3://bucket/key``, patterns included. Endpoint and credentials are found like by the
storage's own tools (for S3: ``AWS_*`` variables, ``~/.aws``, a machine's role), never taken from an address.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereorig.core.errors import ImageError, InputError
from stereorig.server.formats.files import make_folder, written_temporary

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+)://(.*)", re.DOTALL)
_PACKAGES = {"s3": "'stereorig[s3]'", "s3a": "'stereorig[s3]'"}


def is_address(text: str) -> bool:
    """Return True for an address of object storage; False for a path."""
    return _ADDRESS.fullmatch(text) is not None


def copied(option: str, items: Sequence[str], folder: Path) -> list[str]:
    """Copy objects from object storage into a folder; return all items as paths and patterns of this machine.

    Parameters
    ----------
    option
        The option that names them, for messages.
    items
        Paths, patterns and addresses; addresses may have patterns.
    folder
        Copies go there under their own names; it is made if there are any.

    Raises
    ------
    InputError
        ``storage_package_missing``: the storage's package is not installed; ``address_unknown``; ``same_name``: two
        objects have one name.
    ImageError
        ``file_missing``, ``object_forbidden``, ``object_unreadable``, ``object_cut``.
    StorageError
        The copy cannot be written.
    """
    out: list[str] = []
    taken: dict[str, str] = {}
    for item in items:
        if not is_address(item):
            out.append(item)
            continue
        storage, found = _found(option, item)
        for key in found:
            name = key.rsplit("/", 1)[-1]
            if taken.setdefault(name, key) != key:
                raise InputError(
                    f"{option}: {taken[name]} and {key} have the same name.",
                    code="same_name",
                    remedy="Give the objects of one camera different names.",
                )
            make_folder(folder)
            out.append(str(_copy(option, storage, key, folder / name)))
    return out


def _found(option: str, address: str) -> tuple[Any, list[str]]:
    match = _ADDRESS.fullmatch(address)
    assert match is not None
    protocol = match[1]
    try:
        import fsspec

        storage, path = fsspec.core.url_to_fs(address)
    except ImportError as error:
        package = _PACKAGES.get(protocol, f"fsspec and what it needs for {protocol}")
        raise InputError(
            f"{option}: {address} needs a package that is not installed ({error}).",
            code="storage_package_missing",
            remedy=f"Install it: pip install {package}.",
        ) from error
    except ValueError as error:
        raise InputError(
            f"{option}: {protocol} is no storage that is known ({error}).",
            code="address_unknown",
            remedy="Give paths, or addresses such as s3://bucket/key.",
        ) from error
    if re.search(r"[*?\[]", path) is None:
        return storage, [path]
    try:
        found = sorted(storage.glob(path))
    except Exception as error:
        raise _problem(option, address, error) from error
    if not found:
        raise _missing(option, address)
    return storage, [str(key) for key in found]


def _copy(option: str, storage: Any, key: str, path: Path) -> Path:
    try:
        size = storage.info(key)["size"]
        source = storage.open(key, "rb")
    except Exception as error:
        raise _problem(option, key, error) from error
    with written_temporary(path) as temporary, source:
        try:
            with temporary.open("wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)
        except Exception as error:
            if isinstance(error, OSError) and error.errno is not None and error.filename is not None:
                raise  # of the disk
            raise _problem(option, key, error) from error
        got = temporary.stat().st_size
        if size is not None and got != size:
            raise ImageError(
                f"{option}: of {key} {got} bytes came, it has {size}.",
                code="object_cut",
                remedy="The connection ended early: try again.",
            )
    return path


def _missing(option: str, key: str) -> ImageError:
    return ImageError(
        f"{option}: no object {key} is there.",
        code="file_missing",
        remedy="Check bucket, key and endpoint; quote patterns so that the shell leaves them alone.",
    )


def _problem(option: str, key: str, error: Exception) -> ImageError:
    """Return the error for an exception of a storage's package."""
    if isinstance(error, FileNotFoundError):
        return _missing(option, key)
    if isinstance(error, PermissionError) or "Credentials" in type(error).__name__:
        return ImageError(
            f"{option}: {key} may not be read ({error or type(error).__name__}).",
            code="object_forbidden",
            remedy="Give credentials that may read it, for S3 by AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a "
            "profile in ~/.aws.",
        )
    cut = isinstance(error, EOFError) or "Payload" in type(error).__name__
    return ImageError(
        f"{option}: {key} could not be read{' to its end' if cut else ''} ({type(error).__name__}: {error}).",
        code="object_cut" if cut else "object_unreadable",
        remedy="The connection ended early: try again." if cut else "Check that the storage answers, and its endpoint.",
    )
