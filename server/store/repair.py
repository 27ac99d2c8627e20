"""Repair of a data folder: leftovers of a crash are quarantined, the catalogue is rebuilt from the folders."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from stereorig.server.formats.manifest import DamagedError
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import reindex
from stereorig.server.store.tests.steps import quarantine
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import Verification, require_data_folder, verify


@dataclass(frozen=True)
class Repair:
    """The repairs, and the findings of a verification afterwards.

    Parameters
    ----------
    done
        A line for each thing that was changed, each difference between catalogue and folders among them.
    after
        Damaged files are in here: no repair brings them back.
    """

    done: tuple[str, ...]
    after: Verification


def repair(root: Path) -> Repair:
    """Quarantine incomplete steps, remove half-written files, make the catalogue agree with the folders.

    A folder that was put back from a backup, or lost its manifest, is taken as it is from now on.

    Parameters
    ----------
    root
        A data folder that no service uses.

    Raises
    ------
    StateError
        ``data_folder_locked`` when a service runs on it.
    FileFormatError
        As `stereorig.server.store.verify.verify`.
    StorageError
        When the disk fails.
    """
    require_data_folder(root)
    done = [f"finished or removed the half-written {path.relative_to(root)}" for path in sorted(root.rglob(".*.part"))]
    folder = DataFolder(root).open()  # takes the lock
    try:
        tests = TestStore(folder)
        done += _tidy(root.absolute(), tests)
        done += reindex(folder, accept=True)
    finally:
        folder.close()
    return Repair(tuple(done), verify(root))


def _tidy(root: Path, tests: TestStore) -> list[str]:
    done: list[str] = []
    for test_id in tests.ids():
        with contextlib.suppress(DamagedError):  # without its manifest, unacknowledged files cannot be recognised
            done += _tidy_test(root, tests, test_id)
    return done


def _tidy_test(root: Path, tests: TestStore, test_id: str) -> list[str]:
    done, path, known = [], tests.path(test_id), set(tests.steps.numbers(test_id))
    for step in sorted((path / "steps").iterdir()) if (path / "steps").is_dir() else ():
        half = step.is_dir() and step.name.isascii() and step.name.isdigit() and not (step / "step.json").is_file()
        if half and int(step.name) not in known:
            done.append(f"quarantined {step.relative_to(root)} as {quarantine(step).name}: it has no step.json")
    for analysis_id in tests.analyses.ids(test_id):
        for beside in tests.analyses.drop_half_written(test_id, analysis_id):
            done.append(f"removed {beside.relative_to(root)}: its result was never announced")
    return done
