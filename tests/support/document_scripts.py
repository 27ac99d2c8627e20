"""The scripts that documents show, as they are written there, and a process that runs them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from tests.support.requirements import ROOT

#: the service's address in every document
WRITTEN = "http://127.0.0.1:8000"


def blocks(page: str, language: str, like: str = "") -> list[str]:
    """Return a document's blocks in a language, of them those that have a text in it."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return [block for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL) if like in block]


def one_block(page: str, language: str, like: str) -> str:
    """Return a document's one block in a language that has a text in it."""
    found = blocks(page, language, like)
    assert len(found) == 1, f"{len(found)} blocks in {language} with {like} in {page}"
    return found[0]


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, with `stereorig` of this checkout on its path."""
    folders = [str(Path(sys.executable).parent), os.environ["PATH"]]
    packages = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PATH": os.pathsep.join(folders), "PYTHONPATH": os.pathsep.join(packages)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
