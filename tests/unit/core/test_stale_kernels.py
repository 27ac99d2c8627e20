"""Kernels that another version left on disk, with arguments of a class that no longer exists."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.support.requirements import ROOT

MODULE = """
from typing import NamedTuple

from stereorig.core.matching.kernels.naming import entry


class {name}(NamedTuple):
    x: float


@entry
def plus_one(a):
    return a.x + 1.0


print(plus_one({name}(2.0)))
"""


READ_ONLY = """
import errno, os

def refuse(*_):
    raise PermissionError(errno.EACCES, "not ours to write")

os.replace = refuse
"""


def run(folder: Path, name: str, *, before: str = "") -> str:
    (folder / "kernels_of_a_version.py").write_text(MODULE.format(name=name))
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{folder}", "NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-c", f"{before}\nimport kernels_of_a_version"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_class_that_was_renamed_compiles_anew(tmp_path: Path) -> None:
    assert run(tmp_path, "Before") == "3.0"
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert run(tmp_path, "After") == "3.0"
    assert run(tmp_path, "After") == "3.0"


def test_a_file_that_cannot_be_emptied_is_left_and_the_kernel_compiled_in_each_process(tmp_path: Path) -> None:
    assert run(tmp_path, "Before") == "3.0"
    assert run(tmp_path, "After", before=READ_ONLY) == "3.0"
