"""`stereorig doctor` on what an installation lacks: where kernels are kept, rights, the port, a library."""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.library import aravis, repository
from stereorig.server.doctor import Check
from stereorig.server.doctor.access import check_service_port, check_usb_cameras
from stereorig.server.doctor.disk import check_disk
from stereorig.server.doctor.machine import check_kernels
from stereorig.server.doctor.report import Notebook


def check_of(checks: list[Check], part: str, name: str) -> Check:
    (found,) = [check for check in checks if (check.part, check.name) == (part, name)]
    return found


def test_it_says_where_compiled_kernels_are_kept_and_where_they_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def state() -> tuple[str, str]:
        book = Notebook()
        check_kernels(book)
        check = check_of(book.checks, "software", "compiled kernels")
        return check.state, check.found

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    good, text = state()
    assert good == "ok"
    assert text.startswith("none yet: the first start compiles them")
    assert text.endswith(f"({tmp_path / 'cache'})")
    (tmp_path / "cache" / "kernels_1").mkdir(parents=True)
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    index = tmp_path / "cache" / "kernels_1" / f"drivers.run_shape_1-40.{python}.nbi"
    index.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(("stamp", {})))
    assert state()[1].startswith("there already")
    for old in (pickle.dumps("0.1.2"), pickle.dumps(Path("/")), b"", b"junk"):
        index.write_bytes(old)
        assert state()[1].startswith("of another version of Python or numba"), old
    index.rename(index.with_name(index.name.replace(python, "py27")))
    assert state()[1].startswith("of another version of Python or numba")
    # a file in the folder's place: not even root can make anything in it
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert state()[0] == "warning"


def test_where_kernels_can_be_kept_nowhere_the_command_keeps_them_for_as_long_as_it_runs(tmp_path: Path) -> None:
    # files in the folders' places: not even root can make anything in them
    (tmp_path / "home").touch()
    code = (
        "import os, pathlib, sys\n"
        "import stereorig.server.base.kernel_folder as folder\n"
        "folder.kernel_folders.__defaults__ = (pathlib.Path(sys.argv[1]),)\n"
        "import stereorig.server.cli\n"
        "print(os.environ['NUMBA_CACHE_DIR'], os.path.isdir(os.environ['NUMBA_CACHE_DIR']))\n"
    )
    environment = {**os.environ, "HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home" / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", code, str(tmp_path / "home" / "kernels")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    folder, there = done.stdout.split()
    assert there == "True"
    assert not Path(folder).exists()


def test_a_port_that_another_program_listens_on_is_named() -> None:
    book = Notebook()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        check_service_port(book, "127.0.0.1", port)
    check = check_of(book.checks, "service", "port")
    assert check.state == "warning"
    assert f"another program listens on port {port}" in check.found
    assert f"--port {port + 1}" in str(check.remedy)
    free = Notebook()
    check_service_port(free, "127.0.0.1", 0)
    assert check_of(free.checks, "service", "port").state == "ok"
    nowhere = Notebook()
    check_service_port(nowhere, "192.0.2.1", 0)  # an address of no machine
    assert check_of(nowhere.checks, "service", "port").state == "warning"


def usb_camera(folder: Path) -> Path:
    """Write what the system says of a USB3 Vision camera, and its node."""
    device, interface = folder / "sys" / "2-1", folder / "sys" / "2-1:1.0"
    device.mkdir(parents=True)
    interface.mkdir()
    for path, text in {
        device / "busnum": "2",
        device / "devnum": "7",
        device / "product": "Camera X",
        interface / "bInterfaceClass": "ef",
        interface / "bInterfaceSubClass": "05",
    }.items():
        path.write_text(f"{text}\n")
    other = folder / "sys" / "1-1:1.0"  # a keyboard
    other.mkdir()
    (other / "bInterfaceClass").write_text("03\n")
    node = folder / "dev" / "bus" / "usb" / "002" / "007"
    node.parent.mkdir(parents=True)
    node.touch()
    return node


def test_a_usb_camera_that_this_user_may_not_open_is_named_with_the_rule_that_lets_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = usb_camera(tmp_path)
    places = {"devices": tmp_path / "sys", "dev": tmp_path / "dev"}
    book = Notebook()
    check_usb_cameras(book, **places)
    assert [check.state for check in book.checks] == ["ok"]
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != node)  # root may open everything
    check_usb_cameras(book, **places)
    assert book.checks[1].state == "failed"
    assert "Camera X" in book.checks[1].found
    assert "/etc/udev/rules.d" in str(book.checks[1].remedy)
    check_usb_cameras(book, devices=tmp_path / "none", dev=tmp_path / "dev")
    assert len(book.checks) == 2


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("mode", [0o755, 0o700])
def test_a_data_folder_of_another_user_fails_and_says_what_to_do(mode: int) -> None:
    book = Notebook()
    # pytest's own folders may be entered by nobody else
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(mode)
        (Path(folder) / "data").mkdir()
        os.seteuid(65534)
        try:
            check_disk(book, Path(folder) / "data", image_bytes=4096, pairs_per_s=None)
        finally:
            os.seteuid(0)
    check = check_of(book.checks, "disk", "writing")
    assert check.state == "failed"
    assert "65534" in check.found
    assert "chown" in str(check.remedy)


def test_a_missing_aravis_library_is_named_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str, _version: str) -> Any:
        raise ValueError(f"Namespace {name} not available")

    monkeypatch.setitem(sys.modules, "gi", SimpleNamespace(require_version=absent))
    repository.cache_clear()
    try:
        with pytest.raises(CameraError, match="Aravis library cannot be used") as caught:
            aravis()
    finally:
        repository.cache_clear()
    assert "gir1.2-aravis-0.8" in str(caught.value.remedy)
