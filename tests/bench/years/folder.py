"""Data folders of years: one real test, multiplied into many tests of many steps.

The images, result files and checksums of a test's steps are hard links to those of its first; documents are written anew with
their own ids and numbers. What comes out is what captures and analyses leave on disk, at some kilobytes a step.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any


def _same(true: Path, first: Path, name: Path) -> None:
    """Give a file's content another name: a copy for the first in its folder, links to that for the others."""
    if name == first:
        shutil.copyfile(true, name)
    else:
        os.link(first, name)  # a file has 65,000 names at most


class TrueTest:
    """A test that a service made, as the pattern of others."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document: dict[str, Any] = json.loads((path / "test.json").read_bytes())
        self.step: dict[str, Any] = json.loads((path / "steps" / "0001" / "step.json").read_bytes())
        self.analyses = sorted(one for one in (path / "analyses").glob("a*") if (one / "summary.json").is_file())

    def copy(self, number: int, steps: int, *, analysed: bool) -> Path:
        """Make another test of it beside it; returns its folder."""
        test_id = f"t{number:06d}-{number:06x}"
        path = self.path.parent / test_id
        (path / "steps").mkdir(parents=True)
        (path / "analyses").mkdir()
        others = [one.name for one in self.path.iterdir() if one.is_file() and one.suffix != ".json"]
        others += [one.name for one in self.path.glob("calibration*.json")]
        for name in others:
            shutil.copyfile(self.path / name, path / name)
        self.add_steps(path, range(steps))
        if analysed and self.analyses:
            self._analyse(path, number, steps)
        request = {"scope": "tests", "key": test_id, "body_sha256": "0" * 64}
        self._write(path / "test.json", self.document | {"id": test_id, "name": f"test {number}", "request": request})
        return path

    def add_steps(self, path: Path, numbers: range) -> None:
        """Give a test steps; only their number, label, load and key are their own."""
        for n in numbers:
            folder = path / "steps" / f"{n:04d}"
            folder.mkdir()
            for name in ("cam1.tif", "cam2.tif"):
                _same(self.path / "steps" / "0001" / name, folder.parent / "0000" / name, folder / name)
            request = {"scope": f"tests/{path.name}/steps", "key": f"{path.name}-{n}", "body_sha256": "0" * 64}
            own = {"n": n, "test_id": path.name, "label": f"{n / 10:.1f} kN", "load_n": 100.0 * n, "request": request}
            self._write(folder / "step.json", self.step | own)

    def _analyse(self, path: Path, number: int, steps: int) -> None:
        source = self.analyses[0]
        analysis_id = f"a{number:06d}-{number:06x}"
        folder = path / "analyses" / analysis_id
        folder.mkdir()
        found = {"id": analysis_id, "test_id": path.name}
        summary = json.loads((source / "step_0001.json").read_bytes())
        for n in range(steps):
            for suffix in (".nc", ".nc.sha256"):
                _same(source / f"step_0001{suffix}", folder / f"step_0000{suffix}", folder / f"step_{n:04d}{suffix}")
            self._write(folder / f"step_{n:04d}.json", summary | {"n": n})
        document = json.loads((source / "analysis.json").read_bytes())
        sha256 = document["inputs"]["steps"]["1"]
        inputs = document["inputs"] | {"steps": {str(n): sha256 for n in range(steps)}}
        jobs = {"jobs": [{"job_id": f"j{number:06d}-{number:06x}", "created_utc": document["created_utc"]}]}
        self._write(folder / "jobs.json", jobs)
        whole = json.loads((source / "summary.json").read_bytes())
        whole |= {"analysis_id": analysis_id, "job_id": jobs["jobs"][0]["job_id"]}
        self._write(folder / "summary.json", whole | {"steps": [summary | {"n": n} for n in range(steps)]})
        self._write(folder / "analysis.json", document | found | {"steps": list(range(steps)), "inputs": inputs})

    @staticmethod
    def _write(path: Path, document: object) -> None:
        path.write_text(json.dumps(document, indent=1) + "\n")


def multiply(data: Path, tests: int, steps: int, *, longest: int = 5000, analysed_every: int = 10) -> list[str]:
    """Fill a data folder that holds one real test up to so many tests and steps altogether; return the tests' ids.

    The first test that is made has ``longest`` steps where there are more than twice as many, the others share the rest. The catalogue
    is left as it is: the service's start must find the tests in their folders.
    """
    (first,) = (path for path in (data / "tests").iterdir() if (path / "test.json").is_file())
    true = TrueTest(first)
    number = int(first.name[1:7]) + 1
    made = []
    left = steps
    if steps > 2 * longest:
        made.append(true.copy(number, longest, analysed=True).name)
        left -= longest
    others = max(tests - len(made), 1)
    for k in range(others):
        count = left * (k + 1) // others - left * k // others
        made.append(true.copy(number + len(made), count, analysed=k % analysed_every == 0).name)
    return made
