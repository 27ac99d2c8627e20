"""Repair of a data folder: leftovers of a crash are quarantined, the catalogue is made anew from the folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from server.store.folder import DataFolder
from server.store.indexing.build import reindex
from server.store.tests.steps import quarantine
from server.store.tests.tests import TestStore
from server.store.verify import Verification, require_data_folder, verify


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

    Parameters
    ----------
    root
        A data folder that no service uses.

    Raises
    ------
    StateError
        ``data_folder_locked`` when a service runs on it.
    FileFormatError
        As `server.store.verify.verify`.
    StorageError
        When the disk fails.
    """
    require_data_folder(root)
    done = [f"removed the half-written {path.relative_to(root)}" for path in sorted(root.rglob(".*.part"))]
    folder = DataFolder(root).open()  # takes the lock, and removes those
    try:
        tests = TestStore(folder)
        done += _tidy(root.absolute(), tests)
        done += reindex(folder)
    finally:
        folder.close()
    return Repair(tuple(done), verify(root))


def _tidy(root: Path, tests: TestStore) -> list[str]:
    done = []
    for test_id in tests.ids():
        path = tests.path(test_id)
        for step in sorted((path / "steps").iterdir()) if (path / "steps").is_dir() else ():
            if step.is_dir() and step.name.isdigit() and not (step / "step.json").is_file():
                done.append(f"quarantined {step.relative_to(root)} as {quarantine(step).name}: it has no step.json")
        for analysis_id in tests.analyses.ids(test_id):
            for beside in tests.analyses.drop_half_written(test_id, analysis_id):
                done.append(f"removed {beside.relative_to(root)}: its result was never announced")
    return done
