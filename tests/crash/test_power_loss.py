"""Power lost at any instant of a recorded day: whatever the disk then holds, the start loses nothing acknowledged."""

from __future__ import annotations

import os
import random
from bisect import bisect_left
from dataclasses import replace
from pathlib import Path

import pytest

from stereorig.server.store.folder import DataFolder
from stereorig.server.store.verify import verify
from tests.bench.reliability.torture_lab import Pictures
from tests.support.power_loss.check import crash_states, look_at_all
from tests.support.power_loss.journal import EMPTY, Change, Content, Journal, Link, Sync
from tests.support.power_loss.recording import Recording, record
from tests.support.power_loss.states import PowerLoss

STATES = int(os.environ.get("STEREORIG_POWER_LOSS_STATES", "4"))


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    seed = random.SystemRandom().randrange(10**6)
    print(f"day {seed}")
    return record(tmp_path_factory.mktemp("day"), Pictures(4), seed)


def test_nothing_goes_past_the_one_object_that_changes_the_folder(day: Recording) -> None:
    # the lock holds the process' number for people to read, the audit log is appended to, SQLite's files get blocks
    # ahead of their ends and no byte
    kept = {path for path in day.journal.past if not path.startswith("data/.exports/")}  # which a start removes
    assert kept <= {"data/service.lock", "data/audit.log", "data/catalog.sqlite", "data/catalog.sqlite-wal"}
    assert len(day.journal.changes) > 300


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("every", [8, pytest.param(2, marks=pytest.mark.deep)])
def test_no_state_loses_what_was_acknowledged(day: Recording, tmp_path: Path, every: int) -> None:
    states = crash_states(day, random.Random(1), STATES, every)
    found = look_at_all(day, tmp_path, states, print)
    assert found.states > len(day.journal.changes) / every
    assert found.wrong == []


@pytest.mark.parametrize("of", ["folders", "files"])
def test_without_its_syncs_the_same_day_loses_something(day: Recording, tmp_path: Path, of: str) -> None:
    journal, begin = day.journal, day.answers[0].at

    def left_out(change: Change) -> bool:
        return isinstance(change, Sync) and (change.inode in journal.is_folder) == (of == "folders")

    gone = [i for i, change in enumerate(journal.changes) if i >= begin and left_out(change)]
    careless = object.__new__(Journal)
    careless.__dict__ = {
        **journal.__dict__,
        "changes": [c for i, c in enumerate(journal.changes) if i not in set(gone)],
    }
    answers = [replace(answer, at=answer.at - bisect_left(gone, answer.at)) for answer in day.answers]
    states = crash_states(Recording(careless, answers), random.Random(1), 2, 60)
    assert look_at_all(Recording(careless, answers), tmp_path, states, lambda _: None).wrong


def test_a_new_data_folder_is_there_once_it_is_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path)
    monkeypatch.setattr("stereorig.server.formats.disk.disk", journal)
    DataFolder(tmp_path / "lab" / "data").open().close()
    journal.stop()
    disk = PowerLoss(journal.is_folder, journal.blobs)
    for change in journal.changes:
        disk.take(change)
    states = list(disk.states(random.Random(0), 100))
    assert states
    for tree in states:
        assert {"lab/data/tests", "lab/data/calibrations", "lab/data/format.json"} <= set(tree)


# the model of the disk, against what POSIX says -----------------------------------------------------------------


def contents(disk: PowerLoss, most: int = 100) -> set[frozenset[tuple[str, str | None]]]:
    return {frozenset(tree.items()) for tree in disk.states(random.Random(0), most)}


def test_a_file_that_was_not_synced_may_be_anything_and_its_name_may_be_missing() -> None:
    disk = PowerLoss({0}, {EMPTY: b"", "new": b"\x01\x02\x03\x04"})
    for change in (Link(0, "f", 1), Content(1, "new")):
        disk.take(change)
    sizes = {len(disk.blobs[blob]) if blob is not None else None for state in contents(disk) for _, blob in state}
    assert frozenset() in contents(disk)
    assert sizes == {0, 2, 4}
    assert len(contents(disk)) == 5  # no name; no bytes, half of them, zeros, all
    disk.take(Sync(1))
    assert contents(disk) == {frozenset(), frozenset({("f", "new")})}
    disk.take(Sync(0))
    assert contents(disk) == {frozenset({("f", "new")})}


def test_names_of_a_folder_come_and_go_each_by_itself_until_it_is_synced() -> None:
    disk = PowerLoss({0, 1}, {})
    disk.take(Link(0, "folder", 1))
    for inode, name in ((2, "a"), (3, "b"), (4, "c")):
        disk.take(Link(1, name, inode))
    found = {frozenset(path for path, _ in state) for state in contents(disk)}
    assert len(found) == 1 + 2**3  # without the folder's own name, nothing below it is reached
    disk.take(Sync(0))
    assert len(contents(disk)) == 2**3
    disk.take(Sync(1))
    assert len(contents(disk)) == 1


def test_a_copied_test_that_was_given_another_calibration_is_not_called_damaged(day: Recording, tmp_path: Path) -> None:
    # found by the states above: the checksum of the copied test's own calibration is on no record
    assert verify(day.journal.root / "data").sound
