"""HDF5 files that keep their data elsewhere are refused, and nothing else is opened."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.hdf5_parts import require_own_parts
from stereorig.server.formats.models.read import read_model

SECRET = b"0123456789abcdef"


def _external(file: h5py.File, other: str) -> None:
    file.create_dataset("w", (4,), "u1", external=[(other, 0, 4)])


def _link(file: h5py.File, other: str) -> None:
    file["w"] = h5py.ExternalLink(other, "/w")


def _deep_link(file: h5py.File, other: str) -> None:
    file.create_group("a/b/c")["w"] = h5py.ExternalLink(other, "/w")


def _virtual(file: h5py.File, other: str) -> None:
    layout = h5py.VirtualLayout((4,), np.uint8)
    layout[:] = h5py.VirtualSource(other, "w", (4,))
    file.create_virtual_dataset("w", layout)


def _endless_virtual(file: h5py.File, other: str) -> None:
    layout = h5py.VirtualLayout((4,), np.uint8, maxshape=(None,))
    source = h5py.VirtualSource(other, "w", (4,), maxshape=(None,))
    layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
    file.create_virtual_dataset("w", layout)


def _behind_a_soft_link(file: h5py.File, other: str) -> None:
    _external(file.create_group("hidden"), other)
    file["v"] = h5py.SoftLink("/hidden/w")


KINDS = [_external, _link, _deep_link, _virtual, _endless_virtual, _behind_a_soft_link]


@pytest.mark.fault(46)
@pytest.mark.fault(55)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("newest", [False, True])
@pytest.mark.parametrize("head", [0, 4096])
@pytest.mark.parametrize("in_memory", [False, True])
def test_data_that_lie_elsewhere_are_refused_before_anything_is_opened(
    tmp_path: Path, kind: Callable[[h5py.File, str], None], newest: bool, head: int, in_memory: bool
) -> None:
    other = tmp_path / "pipe"  # opened by anything, the test would wait for its other end
    os.mkfifo(other)
    path = tmp_path / "m.h5"
    with h5py.File(path, "w", libver="latest" if newest else "earliest", userblock_size=head) as file:
        file["own"] = np.arange(3.0)
        kind(file, str(other))
    with pytest.raises(FileFormatError) as caught:
        require_own_parts(path, path.read_bytes() if in_memory else None)
    assert caught.value.code == "file_refers_elsewhere"
    assert str(tmp_path) not in str(caught.value)


@pytest.mark.fault(55)
def test_a_model_s_heavy_data_are_looked_through_and_no_text_shows_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(SECRET)
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("t", (3,), "u1", external=[(str(tmp_path / "secret"), 0, 3)])
        file["x"] = np.zeros((1, 3))
        file["own"] = np.array([114, 0, 0])
    text = (
        '<Xdmf><Domain><Grid><Topology TopologyType="Triangle"><DataItem Dimensions="1 3" Format="HDF">m.h5:/{}'
        '</DataItem></Topology><Geometry><DataItem Dimensions="1 3" Format="HDF">m.h5:/x</DataItem></Geometry>'
        "</Grid></Domain></Xdmf>"
    )
    (tmp_path / "m.xdmf").write_text(text.format("t"))
    with pytest.raises(FileFormatError) as caught:
        read_model(tmp_path / "m.xdmf")
    assert caught.value.code == "file_refers_elsewhere"
    with h5py.File(tmp_path / "m.h5", "a") as file:
        del file["t"]
    (tmp_path / "m.xdmf").write_text(text.format("own"))
    with pytest.raises(FileFormatError) as caught:
        read_model(tmp_path / "m.xdmf")
    assert caught.value.code == "model_unreadable"
    assert "114" not in str(caught.value)


def test_whole_files_of_every_kind_pass(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("w", data=np.arange(100.0), chunks=(10,), compression="gzip", shuffle=True, fletcher32=True)
        file["again"] = file["w"]
        file["soft"] = h5py.SoftLink("/nowhere")
    for form in ("NETCDF4", "NETCDF4_CLASSIC", "NETCDF3_CLASSIC"):
        with netCDF4.Dataset(tmp_path / f"{form}.nc", "w", format=form) as data:
            data.createDimension("n", 4)
            data.createVariable("w", "f8", ("n",), zlib=form != "NETCDF3_CLASSIC")[:] = 1.0
    (tmp_path / "text").write_text("no HDF5")
    for path in tmp_path.iterdir():
        require_own_parts(path)
        require_own_parts(path, path.read_bytes())


def test_a_damaged_file_is_refused_by_its_name_alone(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["w"] = np.arange(100.0)
    data = (tmp_path / "a.h5").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(200):
        changed = bytearray(data)
        for k in rng.integers(0, 800, 4):
            changed[k] = rng.integers(0, 256)
        with contextlib.suppress(FileFormatError):  # whole where the damage is in numbers; nothing else is raised
            require_own_parts(tmp_path / "b.h5", bytes(changed))


def _in_itself(file: h5py.File) -> None:
    file.create_group("a")["root"] = file["/"]


def _soft_loop(file: h5py.File) -> None:
    file.create_group("a")["root"] = h5py.SoftLink("/")


def _doubling(file: h5py.File) -> None:
    group = file
    for _ in range(30):
        below = group.create_group("a")
        group["b"] = below
        group = below


@pytest.mark.fault(56)
@pytest.mark.parametrize("kind", [_in_itself, _soft_loop, _doubling])
def test_a_group_under_two_names_is_refused(tmp_path: Path, kind: Callable[[h5py.File], None]) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        kind(file)
    with pytest.raises(FileFormatError, match="two names"):
        require_own_parts(tmp_path / "x.h5")


def test_a_data_set_under_two_names_and_a_soft_link_that_ends_nowhere_are_taken(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["w"] = np.zeros(3)
        file["v"], file["u"], file["t"] = file["w"], h5py.SoftLink("/w"), h5py.SoftLink("/nowhere")
    require_own_parts(tmp_path / "x.h5")
