"""Writes constraints.txt: the versions that a release was tested with, each with the checksums of its files; or compares.

::

    python -m tests.bench.documents.constraints                # write, for the Python versions named in _PYTHONS
    python -m tests.bench.documents.constraints --differences  # what is installed here, beside it
    python -m tests.bench.documents.constraints --unbounded    # what the project needs, without upper bounds

Versions are those of the environment that runs it; pip finds the files and their checksums, in the index that it is
set up with, which the list does not name.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
LIST = ROOT / "constraints.txt"
_PYTHONS = ("3.11", "3.12", "3.13", "3.14")
_PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux_2_27_x86_64", "manylinux2014_x86_64")
_HEAD = """\
# Versions that stereorig {version} was tested with, and the checksums of their files for Linux on x86-64 (CPython {pythons}).
# Written by `python -m tests.bench.documents.constraints`. Exactly these, or nothing:
#     pip install --require-hashes --only-binary :all: -r constraints.txt && pip install --no-deps stereorig
"""


def project() -> dict[str, object]:
    """Return the table of the project."""
    read: dict[str, object] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return read


def unbounded() -> list[str]:
    """Return what program, tests and checks need, without upper bounds."""
    table = project()
    asked = [*table["dependencies"], *table["optional-dependencies"]["dev"]]  # type: ignore[misc, index, call-overload]
    return [re.sub(r",?\s*<=?\s*[0-9][^,;]*", "", one) for one in asked]


def pinned() -> dict[str, str]:
    """Return the versions that constraints.txt names."""
    lines = LIST.read_text(encoding="utf-8").splitlines()
    return dict(line.split(" ")[0].split("==") for line in lines if re.match(r"[a-z0-9]", line))


def checksums(versions: dict[str, str], python: str) -> dict[str, set[str]]:
    """Return the checksums of the wheels that pip chooses for a version of Python."""
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder, "asked.txt")
        asked.write_text("".join(f"{name}=={version}\n" for name, version in versions.items()))
        places = [part for one in _PLATFORMS for part in ("--platform", one)]
        done = subprocess.run(
            [
                *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps"),
                *("--only-binary", ":all:", "--python-version", python, *places, "--target", folder),
                *("--report", "-", "-r", str(asked)),
            ],
            capture_output=True,
            text=True,
            check=True,
        )
    found: dict[str, set[str]] = {}
    for one in json.loads(done.stdout)["install"]:
        name = re.sub(r"[-_.]+", "-", one["metadata"]["name"]).lower()
        found[name] = {one["download_info"]["archive_info"]["hashes"]["sha256"]}
    return found


def text() -> str:
    """Return the list."""
    from tests.bench.documents.install_size import needed

    versions = {name: metadata.version(name) for name in needed()}
    found: dict[str, set[str]] = {name: set() for name in versions}
    for python in _PYTHONS:
        for name, digests in checksums(versions, python).items():
            found[name] |= digests
    head = _HEAD.format(version=project()["version"], pythons=", ".join(_PYTHONS))
    entries = [
        " \\\n".join([f"{name}=={version}", *(f"    --hash=sha256:{one}" for one in sorted(found[name]))])
        for name, version in sorted(versions.items())
    ]
    return head + "\n".join(entries) + "\n"


def differences() -> list[str]:
    """Return the packages whose installed version is not that of constraints.txt."""
    return [
        f"{name} {metadata.version(name)}, tested with {version}"
        for name, version in pinned().items()
        if metadata.version(name) != version
    ]


def main() -> int:
    """Do what is asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--differences", action="store_true")
    parser.add_argument("--unbounded", action="store_true")
    asked = parser.parse_args()
    if asked.unbounded or asked.differences:
        print(
            "\n".join(
                unbounded() if asked.unbounded else differences() or ["nothing: all versions are those of the list"]
            )
        )
        return 0
    LIST.write_text(text(), encoding="utf-8")
    print(f"{LIST.name} has {len(pinned())} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main())
