"""An image of `deploy/Containerfile` and containers of it, without a registry: Debian's packages and wheels are enough.

The base is a Debian made here, with Python and nothing else; the wheels that the program needs are fetched beforehand
and given to the build. buildah builds as root; runc runs a container from a bundle, as an engine would, on a root file
system that cannot be written, without capabilities.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import psutil

from tests.support.requirements import ROOT, missing

_PROGRAMS = ("buildah", "runc", "mmdebstrap")
_PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")
#: what python:slim, the usual base, has too
_PACKAGES = "python3,python3-venv,passwd,libstdc++6"
_NO_INDEX = "[global]\nno-index = true\nfind-links = /wheels\n"


def ran(*command: str | Path, seconds: float = 300.0) -> str:
    """Run a command and return what it prints; its errors are shown where it fails."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


class Image:
    """An image of the program in a store of its own.

    Parameters
    ----------
    folder
        A folder that all of it goes to; 2 GB.
    """

    def __init__(self, folder: Path) -> None:
        if os.geteuid() != 0 or any(shutil.which(name) is None for name in _PROGRAMS):
            missing(f"root and {', '.join(_PROGRAMS)} (Debian packages)")
        self._folder = folder
        self._buildah: list[str | Path] = ["buildah", "--root", folder / "store", "--runroot", folder / "run"]
        driver = "overlay" if self._takes("overlay") else "vfs"
        self._buildah += ["--storage-driver", driver]
        self._make_base()
        self._fetch_wheels()
        self._build(
            *("-t", "stereorig", "--format", "docker", "--build-arg", "BASE=localhost/base"),
            *("--volume", f"{folder / 'wheels'}:/wheels:ro", "-f", ROOT / "deploy" / "Containerfile", ROOT),
        )
        self.config = json.loads(ran(*self._buildah, "inspect", "--type", "image", "stereorig"))["OCIv1"]["config"]
        self.root = Path(ran(*self._buildah, "mount", ran(*self._buildah, "from", "stereorig").strip()).strip())

    def _takes(self, driver: str) -> bool:
        """Whether the folder's file system takes a storage driver."""
        trial = self._folder / "trial"
        stores = ["--root", trial / "store", "--runroot", trial / "run", "--storage-driver", driver]
        done = subprocess.run(["buildah", *map(str, stores), "from", "scratch"], capture_output=True, timeout=60)
        if done.returncode == 0:
            subprocess.run(["buildah", *map(str, stores), "rm", "--all"], capture_output=True, timeout=60)
        return done.returncode == 0

    def _make_base(self) -> None:
        base = self._folder / "base"
        base.mkdir()
        system = dict(line.split("=", 1) for line in Path("/etc/os-release").read_text().splitlines() if "=" in line)
        suite = system.get("VERSION_CODENAME", "stable").strip('"')
        ran("mmdebstrap", "--quiet", "--variant=essential", f"--include={_PACKAGES}", suite, base / "base.tar")
        (base / "pip.conf").write_text(_NO_INDEX)
        (base / "Containerfile").write_text("FROM scratch\nADD base.tar /\nADD pip.conf /etc/pip.conf\n")
        self._build("-t", "base", base)
        (base / "base.tar").unlink()

    def _fetch_wheels(self) -> None:
        python = ran(*self._buildah, "from", "--name", "look", "localhost/base") and ran(
            *(*self._buildah, "run", "--isolation", "chroot", "look", "python3", "-c"),
            "import sys, platform; print('%d.%d' % sys.version_info[:2], platform.machine())",
        )
        version, machine = python.split()
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
        pip += ["--only-binary=:all:", "--python-version", version, "-d", str(self._folder / "wheels")]
        pip += [word for name in _PLATFORMS for word in ("--platform", f"{name}_{machine}")]
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
        ran(*pip, *project["project"]["dependencies"], *project["build-system"]["requires"])

    def _build(self, *words: str | Path) -> None:
        ran(*self._buildah, "bud", "--isolation", "chroot", *words, seconds=600.0)

    def run(self, *command: str, data: Path, seconds: float = 300.0) -> subprocess.CompletedProcess[str]:
        """Run a command as the image's user on a read-only root; ``data`` is ``/data``, the other volume is new.

        Of what the image has in a volume's place, an engine puts a copy into a new volume.
        """
        users = (line.split(":") for line in (self.root / "etc" / "passwd").read_text().splitlines())
        uid, gid = next((int(user[2]), int(user[3])) for user in users if user[0] == self.config["User"])
        data.mkdir(exist_ok=True)
        os.chown(data, uid, gid)
        bundle = data.parent / "bundle"
        shutil.rmtree(bundle, ignore_errors=True)
        bundle.mkdir()
        mounts = []
        for index, place in enumerate(sorted(self.config["Volumes"])):
            volume = data
            if place != "/data":
                volume = bundle / f"volume{index}"
                ran("cp", "--archive", self.root / place.strip("/"), volume)
            mounts.append({"destination": place, "type": "bind", "source": str(volume), "options": ["bind", "rw"]})
        mounts.append({"destination": "/tmp", "type": "tmpfs", "source": "tmpfs", "options": ["mode=1777"]})
        ran("runc", "spec", "--bundle", bundle)
        spec: dict[str, Any] = json.loads((bundle / "config.json").read_text())
        spec["root"] = {"path": str(self.root), "readonly": True}
        spec["mounts"] += mounts
        process = spec["process"]
        process |= {"terminal": False, "user": {"uid": uid, "gid": gid}, "args": list(command), "cwd": "/"}
        process["env"] = self.config["Env"]
        process["capabilities"] = {}
        process.pop("rlimits", None)
        (bundle / "config.json").write_text(json.dumps(spec))
        name = f"stereorig-test-{os.getpid()}"
        words = ["runc", "--root", str(self._folder / "runc"), "run", "--bundle", str(bundle), name]
        return subprocess.run(words, capture_output=True, text=True, timeout=seconds)

    def close(self) -> None:
        """Take everything away."""
        subprocess.run([*map(str, self._buildah), "umount", "--all"], capture_output=True, timeout=60)
        subprocess.run([*map(str, self._buildah), "rm", "--all"], capture_output=True, timeout=60)
        shutil.rmtree(self._folder, ignore_errors=True)


def unmount_leftovers() -> None:
    """Unmount the images of killed test runs: pytest could not delete their temporary folders."""
    for line in Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines():
        mounted = re.match(r"\S+ ((\S+/pytest-of-[^/ ]+/pytest-\d+)/\S+) ", line)
        if mounted is not None:
            lock = Path(mounted[2]) / ".lock"  # holds the process number of the run that made the folder
            if not (lock.is_file() and psutil.pid_exists(int(lock.read_text() or 0))):
                subprocess.run(["umount", "--lazy", mounted[1]], capture_output=True, timeout=60)
