"""The catalogue's index is believed after a clean stop alone, and about what was not touched since."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import Index
from stereorig.server.store.indexing.clean_stop import MARK, leave_mark, take_mark
from stereorig.server.store.tests.tests import TestStore

LONG_AGO_NS = time.time_ns() - 3_600_000_000_000


class Bench:
    """A data folder whose catalogue is opened and closed as a service does it."""

    def __init__(self, root: Path) -> None:
        self.folder = DataFolder(root).open()
        self.tests = TestStore(self.folder)
        self.catalog: Any = None
        self.index: Any = None

    def start(self) -> dict[str, Any]:
        """Begin; return what the mark vouched for, and which tests had to be read."""
        path = self.folder.root / "catalog.sqlite"
        known = take_mark(path)
        self.catalog = Catalog(path).open(sound=known is not None)
        self.tests = TestStore(self.folder)
        self.index = Index(self.catalog, self.folder, CalibrationStore(self.folder), self.tests)
        self.index.begin(known)
        return {"known": known, "waiting": set(self.index._waiting)}

    def stop(self, *, clean: bool = True) -> None:
        self.index.finish()
        self.catalog.close()
        if clean:
            self.index.leave_mark()

    def new_test(self, steps: int) -> str:
        made = self.tests.create({"name": "one", "specimen": "", "notes": ""}, None)
        for n in range(steps):
            images = {"cam1": b"one", "cam2": b"two"}
            request = {"scope": f"tests/{made.id}/steps", "key": f"k{n}", "body_sha256": "0"}
            self.tests.steps.add(made.id, images, {"label": f"{n}", "source": "import", "request": request})
        return made.id

    def labels(self, test_id: str) -> list[object]:
        return [entry["label"] for entry in self.catalog.entries("step", test_id)]

    def age(self) -> None:
        """Let everything in the folders of the tests be an hour old."""
        for path in [self.folder.tests, *self.folder.tests.rglob("*")]:
            os.utime(path, ns=(LONG_AGO_NS, LONG_AGO_NS))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "data")
    made.start()
    for steps in (3, 2):
        made.new_test(steps)
    made.stop(clean=False)
    made.age()
    made.start()
    made.stop()
    yield made
    made.folder.close()


def test_after_a_clean_stop_nothing_is_read_and_every_list_is_whole(bench: Bench) -> None:
    one, two = bench.tests.ids()
    assert bench.start()["waiting"] == set()
    assert not (bench.folder.root / MARK).exists(), "a kill from here on leaves no mark"
    assert bench.labels(one) == ["0", "1", "2"]
    assert bench.labels(two) == ["0", "1"]
    assert [entry["id"] for entry in bench.catalog.entries("test")] == [one, two]
    bench.stop()
    assert bench.index.differences == []


def test_without_a_clean_stop_every_test_is_read(bench: Bench) -> None:
    bench.start()
    bench.stop(clean=False)
    begun = bench.start()
    assert begun["known"] is None
    assert begun["waiting"] == set(bench.tests.ids())
    bench.stop()


def _older(data: Path) -> None:
    """The catalogue is that of another time: whole, and wrong."""
    catalog = Catalog(data / "catalog.sqlite").open()
    catalog.put_entry("step", next(p.name for p in (data / "tests").iterdir()), "0009", {"n": 9, "label": "ghost"})
    catalog.close()


def _cut(data: Path) -> None:
    content = (data / "catalog.sqlite").read_bytes()
    (data / "catalog.sqlite").write_bytes(content[: len(content) // 2])


def _of_another_folder(data: Path) -> None:
    other = Bench(data.parent / "other")
    other.start()
    other.new_test(1)
    other.stop()
    other.folder.close()
    shutil.copy(data.parent / "other" / "catalog.sqlite", data / "catalog.sqlite")


def _log_beside(data: Path) -> None:
    (data / "catalog.sqlite-wal").write_bytes(b"")


def _mark_cut(data: Path) -> None:
    content = (data / MARK).read_bytes()
    (data / MARK).write_bytes(content[: len(content) // 2])


def _of_another_version(data: Path) -> None:
    mark = json.loads((data / MARK).read_text())
    (data / MARK).write_text(json.dumps(mark | {"software": "0.0.1"}))


@pytest.mark.parametrize("spoil", [_older, _cut, _of_another_folder, _log_beside, _mark_cut, _of_another_version])
def test_an_index_that_is_not_the_one_that_was_closed_is_not_believed(
    bench: Bench, spoil: Callable[[Path], None]
) -> None:
    spoil(bench.folder.root)
    begun = bench.start()
    assert begun["known"] is None
    one, two = bench.tests.ids()
    assert bench.labels(one) == ["0", "1", "2"]
    assert bench.labels(two) == ["0", "1"]
    bench.stop()


def test_a_mark_and_catalogue_copied_from_another_folder_are_not_believed(bench: Bench, tmp_path: Path) -> None:
    other = Bench(tmp_path / "other")
    other.start()
    other.new_test(1)
    other.stop()
    other.folder.close()
    for name in ("catalog.sqlite", MARK):
        shutil.copy(other.folder.root / name, bench.folder.root / name)
    assert bench.start()["waiting"] == set(bench.tests.ids())
    assert [entry["id"] for entry in bench.catalog.entries("test")] == bench.tests.ids()
    bench.stop()


def _step_copied(test: Path) -> None:
    shutil.copytree(test / "steps" / "0000", test / "steps" / "0007")


def _step_taken_away(test: Path) -> None:
    shutil.rmtree(test / "steps" / "0001")


def _document_edited_in_place(test: Path) -> None:
    document = json.loads((test / "test.json").read_text())
    with (test / "test.json").open("r+") as file:
        file.write(json.dumps(document | {"name": "two"}))
        file.truncate()


def _folder_copied(test: Path) -> None:
    shutil.copytree(test, test.with_name("t000099-abcdef"))


@pytest.mark.parametrize("change", [_step_copied, _step_taken_away, _document_edited_in_place, _folder_copied])
def test_a_test_that_was_changed_by_hand_meanwhile_is_read_again_and_no_other(
    bench: Bench, change: Callable[[Path], None]
) -> None:
    one, two = bench.tests.ids()
    change(bench.folder.tests / one)
    changed = "t000099-abcdef" if change is _folder_copied else one
    assert bench.start()["waiting"] == {changed}
    if change is _folder_copied:
        with pytest.raises(FileFormatError, match="is a copy of"):
            bench.tests.steps.numbers(changed)
    else:
        assert bench.tests.steps.numbers(changed) == [0, 1, 2]  # a copy is none, and one that was lost is named
    listed = {"t000099-abcdef": [], one: [0, 2] if change is _step_taken_away else [0, 1, 2]}[changed]
    assert [entry["n"] for entry in bench.catalog.entries("step", changed)] == listed
    assert bench.labels(two) == ["0", "1"]
    bench.stop()


def test_a_test_that_was_removed_meanwhile_is_in_no_list(bench: Bench) -> None:
    one, two = bench.tests.ids()
    shutil.rmtree(bench.folder.tests / one)
    bench.start()
    assert [entry["id"] for entry in bench.catalog.entries("test")] == [two]
    assert bench.catalog.entries("step", one) == []
    with pytest.raises(NotFoundError):
        bench.tests.path(one)
    bench.stop()


def test_a_test_that_was_changed_just_before_the_stop_is_read_again(bench: Bench) -> None:
    bench.start()
    two = bench.tests.ids()[1]
    bench.tests.steps.add(two, {"cam1": b"1", "cam2": b"2"}, {"label": "unseen"})  # killed before it was announced
    bench.stop()
    assert bench.start()["waiting"] == {two}
    assert bench.labels(two) == ["0", "1", "unseen"]
    bench.stop()


def test_a_list_or_a_change_of_a_test_that_waits_reads_it_first(bench: Bench) -> None:
    bench.start()
    bench.stop(clean=False)
    (bench.folder.root / "catalog.sqlite").unlink()
    bench.start()
    one, two = bench.tests.ids()
    assert bench.labels(one) == ["0", "1", "2"]
    assert bench.index.waiting() == 1
    key = f"tests/{two}/steps", "k1"
    assert bench.catalog.request(*key) is None
    bench.index.read(two)
    assert bench.catalog.request(*key) == ("0", {"test_id": two, "n": 1})
    assert bench.index.waiting() == 0
    bench.stop()


def test_what_was_half_written_is_removed_before_the_test_is_changed(bench: Bench) -> None:
    bench.start()
    bench.stop(clean=False)
    one, _ = bench.tests.ids()
    half = bench.folder.tests / one / "steps" / "0001" / ".step.json.0a1b2c3d.part"
    half.write_bytes(b"half")
    bench.start()
    bench.tests.update(one, {"notes": "changed"})
    assert not half.exists()
    bench.stop()


def test_the_mark_of_a_stop_names_every_test_that_had_settled(bench: Bench) -> None:
    tests = [bench.folder.tests / test_id for test_id in bench.tests.ids()]
    leave_mark(bench.folder.root / "catalog.sqlite", tests)
    known = take_mark(bench.folder.root / "catalog.sqlite")
    assert known is not None
    assert set(known) == {path.name for path in tests}
