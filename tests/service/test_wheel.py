"""The wheel works in a fresh environment, without the checkout: the command, the rig files, the page, the client.

The environment sees the packages that the program needs where they are installed already; the program itself comes from
the wheel alone. The whole demo from the wheel is left to STEREORIG_WHEEL_DEMO=1: it compiles every kernel anew.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.support.requirements import ROOT, missing

pytestmark = [pytest.mark.deep, pytest.mark.delivered, pytest.mark.timeout(600)]
_SOURCES = ("core", "drivers", "server", "sim", "stereorig", "config", "pyproject.toml", "README.md", "LICENSE")


def ran(command: list[str], folder: Path, seconds: float = 200.0) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=seconds)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it of a copy of the sources, as nothing may be left in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in _SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    done = ran([*pip, "-w", str(folder / "dist"), str(folder)], folder)
    if done.returncode and "setuptools" in done.stderr:
        missing("setuptools from a package index, to build the wheel with")
    assert done.returncode == 0, done.stderr
    return next((folder / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of a fresh environment with the wheel in it."""
    folder = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True, timeout=60)
    packages = next(folder.glob("lib/python*/site-packages"))
    # .pth files there are not followed, so an editable installation of the checkout is not seen
    (packages / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--quiet"]
    more = ["--disable-pip-version-check", "--no-deps", "--no-index", "--ignore-installed", str(wheel)]
    done = ran([*pip, *more], folder)
    assert done.returncode == 0, done.stderr
    return folder / "bin"


def test_the_wheel_holds_everything_that_is_no_python(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        listed = archive.namelist()
    names = set(listed)
    assert len(listed) == len(names)
    assert "stereorig/py.typed" in names
    static = {path.relative_to(ROOT) for path in (ROOT / "server" / "static").rglob("*") if path.is_file()}
    assert {f"stereorig/{path}" for path in static} <= names
    assert {name.rpartition("/")[2] for name in names if name.endswith(".toml")} == {
        path.name for path in (ROOT / "config").glob("sim_*.toml")
    }


def test_the_wheel_installs_one_import_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        folders = {name.partition("/")[0] for name in archive.namelist()}
    assert {name for name in folders if not name.endswith((".dist-info", ".data"))} == {"stereorig"}


def test_the_program_comes_from_the_wheel_and_not_from_the_checkout(installed: Path, tmp_path: Path) -> None:
    code = "import stereorig.server; print(stereorig.Client.__name__, stereorig.server.__file__)"
    done = ran([str(installed / "python"), "-c", code], tmp_path)
    assert done.returncode == 0, done.stderr
    name, path = done.stdout.split()
    assert name == "Client"
    assert Path(path).is_relative_to(installed.parent)


def test_doctor_finds_the_simulated_rig_and_names_what_is_missing(installed: Path, tmp_path: Path) -> None:
    done = ran([str(installed / "stereorig"), "doctor", "--seconds", "0.3"], tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "share/stereorig/config/sim_paper.toml" in done.stdout
    assert "software packages" in done.stdout
    assert "software extras" in done.stdout


@pytest.mark.skipif("STEREORIG_WHEEL_DEMO" not in os.environ, reason="STEREORIG_WHEEL_DEMO is not set")
def test_the_demo_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    done = ran([str(installed / "stereorig"), "demo", "--out", str(tmp_path / "out")], tmp_path, 550.0)
    assert done.returncode == 0, done.stdout + done.stderr
