"""What the checks of an analysis look at is read again only where one of the files was touched."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from stereorig.server.results.warnings import checks
from stereorig.server.results.warnings.checks import checks_if_changed, checks_of, state_of

ANALYSIS, STEPS = "a000001-abcdef", 3


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An analysis of three steps, in its test's folder, in a data folder with the calibration's own."""
    test = tmp_path / "tests" / "t000001-abcdef"
    made = test / "analyses" / ANALYSIS
    made.mkdir(parents=True)
    shas = {str(n): {"cam1": "0" * 64, "cam2": "1" * 64} for n in range(STEPS)}
    inputs = {"calibration_sha256": "2" * 64, "steps": shas}
    document = {
        "id": ANALYSIS,
        "test_id": test.name,
        "created_utc": "2026-01-01T00:00:00Z",
        "kind": "displacement",
        "steps": list(range(STEPS)),
        "settings": {},
        "inputs": inputs,
    }
    put(made / "analysis.json", document)
    put(test / "test.json", {"calibration_id": "c000001-abcdef", "calibration_sha256": "2" * 64})
    put(test / "calibration.json", {})
    put(tmp_path / "calibrations" / "c000001-abcdef" / "calibration.json", {})
    for n in range(STEPS):
        step = test / "steps" / f"{n:04d}"
        for name in ("cam1.tif", "cam2.tif"):
            put(step / name, n)
        put(step / "step.json", {"n": n, "sha256": shas[str(n)]})
        put(made / f"step_{n:04d}.json", {"n": n, "valid_fraction": 1.0})
        put(made / f"step_{n:04d}.nc", n)
    return made


def put(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def in_place(path: Path, text: str) -> None:
    """Write as many other bytes into a file, and give it back the time that a program can set."""
    before = path.stat()
    with path.open("r+") as file:
        file.write(text)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size


def test_an_unchanged_analysis_has_one_state_and_is_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state, found = checks_if_changed(folder, None, None)
    assert found == checks_of(folder)
    monkeypatch.setattr(checks, "checks_of", lambda *_: pytest.fail("read again"))
    assert checks_if_changed(folder, None, state) == (state, None)
    (folder.parent / "a000002-abcdef").mkdir()  # another analysis of the test
    put(folder.parent / "a000002-abcdef" / "analysis.json", {})
    assert state_of(folder) == state


TOUCHES: dict[str, Callable[[Path, Path, Path], object]] = {
    "a step's summary": lambda folder, _test, _data: put(folder / "step_0001.json", {"n": 1, "valid_fraction": 0.1}),
    "a result": lambda folder, _test, _data: (folder / "step_0002.nc").unlink(),
    "the summary": lambda folder, _test, _data: put(folder / "summary.json", {"steps_failed": {}}),
    "a step": lambda _folder, test, _data: shutil.rmtree(test / "steps" / "0002"),
    "a step's record in place": lambda _folder, test, _data: in_place(test / "steps/0001/step.json", '{"m"'),
    "an image in place": lambda _folder, test, _data: in_place(test / "steps/0001/cam2.tif", "7"),
    "the test": lambda _folder, test, _data: put(test / "test.json", {}),
    "its calibration": lambda _folder, test, _data: put(test / "calibration.json", {"verdict": {"level": "failed"}}),
    "a later one": lambda _folder, test, _data: put(test / "calibrations" / f"{'2' * 64}.json", {}),
    "its review": lambda _folder, _test, data: put(
        data / "calibrations/c000001-abcdef/review.json", {"decision": "discarded"}
    ),
}


@pytest.mark.parametrize("touched", TOUCHES)
def test_a_file_that_is_touched_changes_the_state(folder: Path, touched: str) -> None:
    state, before = checks_if_changed(folder, None, None)
    assert before is not None
    test = folder.parent.parent
    TOUCHES[touched](folder, test, test.parent.parent)
    after, found = checks_if_changed(folder, None, state)
    assert after != state
    assert found == checks_of(folder)
