"""Makes a release: ``python -m tests.bench.documents.release`` writes everything that is published into ``dist/``.

Wheel and source archive, bill of materials, the version's changes, a citation file, the container's file, checksums. Then
the wheel is installed into a fresh environment and its command is run. Nothing is published. Refused are a checkout with
changes, whose files would not be those of a commit, and a version that the changelog does not begin with.
"""

from __future__ import annotations

import hashlib
import io
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

from tests.bench.documents.bill_of_materials import put_into
from tests.support.requirements import ROOT

_PAPER = "10.1117/1.600624"


def project() -> dict[str, Any]:
    """Return the project's table of ``pyproject.toml``."""
    found: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return found


def changes(text: str, version: str) -> str:
    """Return the section of a version, the newest one, of the changelog's text.

    Raises
    ------
    SystemExit
        The changelog begins with another version.
    """
    sections = re.split(r"(?m)^## ", text)[1:]
    head, _, body = sections[0].partition("\n")
    if head.split()[0] != version:
        raise SystemExit(f"CHANGELOG.md begins with {head}, and pyproject.toml has {version}: make them one.")
    return f"# stereorig {version}\n{body.rstrip()}\n"


def citation(version: str, date: str, title: str) -> str:
    """Return the citation file (Citation File Format 1.2.0)."""
    return f"""cff-version: 1.2.0
message: Cite the program by this entry, and the method by the paper below it.
type: software
title: "stereorig: {title}"
version: {version}
date-released: {date}
license: BSD-3-Clause
authors:
  - name: the stereorig authors
references:
  - type: article
    title: Improved three-dimensional image correlation for surface displacement measurement
    authors:
      - {{family-names: Helm, given-names: Jeffrey D.}}
      - {{family-names: McNeill, given-names: Stephen R.}}
      - {{family-names: Sutton, given-names: Michael A.}}
    journal: Optical Engineering
    year: 1996
    volume: 35
    issue: 7
    start: 1911
    doi: {_PAPER}
"""


def source_archive(wheel: Path, out: Path) -> Path:
    """Write the source archive of the last commit, with the wheel's metadata as PEP 517 wants them; return its path."""
    name = "-".join(wheel.name.split("-")[:2])
    with zipfile.ZipFile(wheel) as opened:
        metadata = opened.read(next(one for one in opened.namelist() if one.endswith(".dist-info/METADATA")))
    archive = ["git", "archive", "--format=tar", f"--prefix={name}/", "HEAD"]
    content = io.BytesIO(subprocess.run(archive, cwd=ROOT, check=True, capture_output=True).stdout)
    path = out / f"{name}.tar.gz"
    with tarfile.open(fileobj=content) as tree, tarfile.open(path, "w:gz", format=tarfile.PAX_FORMAT) as packed:
        for entry in tree:
            packed.addfile(entry, tree.extractfile(entry) if entry.isfile() else None)
        entry = tarfile.TarInfo(f"{name}/PKG-INFO")
        entry.size = len(metadata)
        packed.addfile(entry, io.BytesIO(metadata))
    return path


def checksums(folder: Path) -> str:
    """Return the SHA-256 of each file of a folder, as ``sha256sum -c`` reads them."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name != "SHA256SUMS")
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files)


def tried(wheel: Path) -> str:
    """Install a wheel into a fresh environment with what it needs; return the version that its command prints."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        commands = Path(folder) / "bin"
        pip = [str(commands / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, str(wheel)], cwd=folder, check=True)
        subprocess.run(
            [str(commands / "python"), "-c", "import stereorig; stereorig.Measurement"], cwd=folder, check=True
        )
        asked = [str(commands / "stereorig"), "--version"]
        return subprocess.run(asked, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def make(out: Path) -> list[Path]:
    """Make all files of the release; return them."""
    about = project()
    if subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, check=True, capture_output=True).stdout:
        raise SystemExit("The checkout has changes: commit them, so that the release is that of a commit.")
    notes = changes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), about["version"])
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    # of a clone: what earlier builds left in the checkout would be in the wheel
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["git", "clone", "--quiet", str(ROOT), folder], check=True)
        pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "-w", str(out), folder], check=True)
    (wheel,) = out.glob("*.whl")
    put_into(wheel)
    source_archive(wheel, out)
    date = subprocess.run(["git", "log", "-1", "--format=%cs"], cwd=ROOT, check=True, capture_output=True, text=True)
    (out / "CITATION.cff").write_text(citation(about["version"], date.stdout.strip(), about["description"]), "utf-8")
    (out / f"CHANGES-{about['version']}.md").write_text(notes, encoding="utf-8")
    for name in ("deploy/Containerfile", "constraints.txt", "LICENSE"):
        shutil.copy(ROOT / name, out)
    (out / "SHA256SUMS").write_text(checksums(out), encoding="utf-8")
    said = tried(wheel)
    if said != f"stereorig {about['version']}":
        raise SystemExit(f"The wheel in a fresh environment says {said!r}.")
    return sorted(out.iterdir())


if __name__ == "__main__":
    for made in make(ROOT / "dist"):
        print(f"{made.stat().st_size / 2**20:8.2f} MiB  {made.relative_to(ROOT)}")
