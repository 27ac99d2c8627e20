"""HDF5 files of other programs, looked through before anything is read: they may name other files as their own parts.

External storage, external links and virtual data sets are followed by the HDF5 library without a word, and netCDF4 does
not show them. h5py does; nothing of another file is opened by looking.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import h5py
from h5py import h5d, h5f, h5g, h5l, h5o, h5p

from stereorig.core.errors import FileFormatError

_MAX_OBJECTS = 100_000
_FILTERS = (1, 2, 3, 4, 5, 6)  # HDF5's own; others are loaded as programs from folders of the machine
_HDF5_MARK = b"\x89HDF\r\n\x1a\n"


def require_own_parts(path: Path, content: bytes | None = None) -> None:
    """Raise an error for an HDF5 file that holds less than all of its data; other files are left alone.

    Parameters
    ----------
    path
        Path of the file; only its name is in errors.
    content
        Content of the file, which is then not opened.

    Raises
    ------
    FileFormatError
        ``file_refers_elsewhere``; ``file_unreadable`` for a file that HDF5 cannot read.
    """
    try:
        if content is None:
            if not h5f.is_hdf5(bytes(path)):
                return
            file = h5f.open(bytes(path), h5f.ACC_RDONLY)
        else:
            places = (0, *(512 << k for k in range(len(content).bit_length())))  # after another program's block
            if not any(content.startswith(_HDF5_MARK, place) for place in places):
                return
            file = h5f.open_file_image(content)
        with h5py.File(file) as opened:
            _walk(opened.id, path.name)
    except FileFormatError:
        raise
    except Exception as error:  # a damaged file can fail anywhere inside the library
        raise FileFormatError(f"{path.name} cannot be read as HDF5.", file=path.name) from error


def _walk(file: h5f.FileID, name: str) -> None:
    waiting, soft = [h5g.open(file, b"/")], []
    seen = {h5o.get_info(waiting[0]).addr}
    while waiting:
        group = waiting.pop()
        for k in range(group.get_num_objs()):
            link = group.get_objname_by_idx(k)
            kind = group.links.get_info(link).type
            if kind == h5l.TYPE_SOFT:
                soft.append((group, link))
                continue
            if kind != h5l.TYPE_HARD:
                raise _elsewhere(name, "a link to another file")
            held = h5o.get_info(group, link)
            if held.addr in seen:
                _require_one_name(held.type, name)
                continue
            seen.add(held.addr)
            if len(seen) > _MAX_OBJECTS:
                raise FileFormatError(f"{name} has more than {_MAX_OBJECTS} parts.", file=name)
            if held.type == h5o.TYPE_GROUP:
                waiting.append(h5g.open(group, link))
            elif held.type == h5o.TYPE_DATASET:
                _check(h5d.open(group, link).get_create_plist(), name)

    for group, link in soft:  # now that no link leaves the file
        with contextlib.suppress(KeyError, ValueError, RuntimeError, OSError):  # of a target that is not there
            _require_one_name(h5o.get_info(group, link).type, name)


def _require_one_name(kind: int, name: str) -> None:
    """Refuse a group under two names, which netCDF would read as often as it is reached, and for ever in a loop."""
    if kind == h5o.TYPE_GROUP:
        raise FileFormatError(f"{name} has a group under two names.", file=name)


def _check(made: h5p.PropDCID, name: str) -> None:
    if made.get_external_count():
        raise _elsewhere(name, "a data set whose numbers are in another file")
    if made.get_layout() == h5d.VIRTUAL:
        raise _elsewhere(name, "a data set that is put together from others")
    if any(made.get_filter(k)[0] not in _FILTERS for k in range(made.get_nfilters())):
        raise _elsewhere(name, "a data set that only a program outside HDF5 can unpack")


def _elsewhere(name: str, cause: str) -> FileFormatError:
    return FileFormatError(
        f"{name} holds {cause}.",
        code="file_refers_elsewhere",
        remedy="Write all data into the file itself, with HDF5's own compression or none; nothing else was opened.",
        file=name,
    )
