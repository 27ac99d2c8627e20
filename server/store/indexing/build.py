"""The index of a data folder: tests that it cannot be right about are read, one by one, behind the running service.

A test that waits to be read is read at once when something is asked of it, so that no list lacks anything, or before
something is written into it, so that nothing is done twice. Documents of single things come from their files always.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.base.problem import RESTART, problem_of
from stereorig.server.formats.manifest import NAME, DamagedError, differs_from, kept, read_manifest
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog, Entry
from stereorig.server.store.folder import DataFolder, is_id
from stereorig.server.store.indexing.clean_stop import Times, leave_mark, take_mark, times_of
from stereorig.server.store.indexing.entries import calibration_entry, check_trash, entries_of_test, test_entry
from stereorig.server.store.indexing.lost_jobs import LostJobs
from stereorig.server.store.manifests import finish_renaming
from stereorig.server.store.noise import NoiseStore
from stereorig.server.store.tests.tests import TestStore

_log = logging.getLogger("stereorig.service")
#: the background's share of a processor: requests come first
_REST = 1.0


class Index:
    """Keeps the catalogue's index in agreement with the folders.

    Attributes
    ----------
    differences
        Lines: where index and folders differed, and files that cannot be read.
    """

    def __init__(
        self,
        catalog: Catalog,
        folder: DataFolder,
        calibrations: CalibrationStore,
        tests: TestStore,
        noise: NoiseStore | None = None,
    ) -> None:
        self._catalog, self._folder = catalog, folder
        self._calibrations, self._tests, self._noise = calibrations, tests, noise
        self._turn = threading.Condition()
        self._waiting: dict[str, None] = {}  # the newest first
        self._reading: set[str] = set()
        self._begun = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="index", daemon=True)
        self.differences: list[str] = []

    def begin(self, known: Mapping[str, Times] | None) -> None:
        """Read all that is few; find out which tests must be read.

        Also takes over ids, and the Idempotency-Keys of tests and calibrations.

        Parameters
        ----------
        known
            Times of the tests that the index is right about if they are unchanged, see
            :func:`stereorig.server.store.indexing.clean_stop.take_mark`.
        """
        lost, trouble = LostJobs(), check_trash(self._folder)
        calibrations = self._read_calibrations(lost, trouble)
        indexed = self._catalog.entry_ids("test")
        self._finish_halves_of_tests()
        there = self._tests.ids()
        tests: list[Entry] = []
        for test_id in there:
            self._reserve(test_id)
            path = self._folder.tests / test_id
            unchanged = known is not None and test_id in indexed and known.get(test_id) == times_of(path)
            if unchanged and (path / NAME).exists():
                continue
            self._waiting[test_id] = None
            try:
                document = self._tests.read(test_id)
                lost.made(document.request, {"test_id": test_id})
                tests.append(("test", "", test_id, test_entry(document)))
            except (FileFormatError, KeyError) as error:
                trouble.append(f"test {test_id}: {error}")
        self._waiting = dict.fromkeys(reversed(self._waiting))
        self.differences += self._catalog.replace_tests(calibrations, tests, gone=indexed - set(there)) + trouble
        lost.restore(self._catalog, self._folder.ids)
        self._catalog.before_parts = self._tests.folders.before_change = self.read
        self._begun = True

    def _reserve(self, test_id: str) -> None:
        self._folder.ids.reserve(test_id)
        analyses = self._folder.tests / test_id / "analyses"
        for name in os.listdir(analyses) if analyses.is_dir() else ():  # noqa: PTH208 - names, not paths
            if is_id(name, "a"):
                self._folder.ids.reserve(name)

    def _read_calibrations(self, lost: LostJobs, trouble: list[str]) -> list[Entry]:
        entries: list[Entry] = []
        root = self._folder.root
        for home in (root / "recipes", *root.glob("noise/n*"), *root.glob("certificates/v*")):
            if home.is_dir() and (home.name == "recipes" or is_id(home.name, home.name[0])):
                self._folder.manifests.settle(home)
        for calibration_id in self._calibrations.ids():
            self._folder.ids.reserve(calibration_id)
            self._folder.manifests.settle(self._folder.calibrations / calibration_id)
            try:
                if self._calibrations.read(calibration_id).state == "unfinished":
                    # no job works on it any more: the job that did ended with the last service
                    self._calibrations.put_failure(calibration_id, problem_of(RESTART).plain())
                lost.calibration(self._calibrations.read(calibration_id))
                entry = calibration_entry(self._calibrations, calibration_id)
                entries.append(("calibration", "", calibration_id, entry))
            except (FileFormatError, KeyError) as error:
                trouble.append(f"calibration {calibration_id}: {error}")
        for noise_id in () if self._noise is None else self._noise.ids():
            assert self._noise is not None
            try:
                lost.noise(self._noise.read(noise_id))
            except (FileFormatError, KeyError) as error:
                trouble.append(f"noise measurement {noise_id}: {error}")
        return entries

    def _finish_halves_of_tests(self) -> None:
        """Finish folders that were about to become tests, or remove the temporary files from them."""
        for path in self._folder.tests.iterdir():
            if path.is_dir() and not (path / "test.json").is_file():
                finish_renaming(path)

    # reading --------------------------------------------------------------------------------------------------------

    def read(self, test_id: str) -> None:
        """Read a test's folder into the index, unless that was done; returns once the index is right about it."""
        with self._turn:
            while test_id in self._reading:
                self._turn.wait()
            if test_id not in self._waiting:
                return
            del self._waiting[test_id]
            self._reading.add(test_id)
        done = False
        try:
            self._read(test_id)
            done = True
        finally:
            with self._turn:
                self._reading.discard(test_id)
                if not done:  # the disk or the catalogue failed: the next who asks tries again
                    self._waiting[test_id] = None
                self._turn.notify_all()

    def _read(self, test_id: str) -> None:
        trouble: list[str] = []
        lost = LostJobs()
        path = self._folder.tests / test_id
        self._folder.manifests.settle(path)
        gone = not (path / "test.json").is_file()  # removed by hand since
        found: list[str] = []
        try:
            entries = [] if gone else entries_of_test(self._tests, test_id, lost, trouble)
        except DamagedError as error:  # of the manifest: the list stays, and each request names the damage
            trouble = [f"test {test_id}: {error}"]
        else:
            lost.restore(self._catalog, self._folder.ids)
            found = self._catalog.replace_test(test_id, entries)
        found += trouble
        for line in found:
            _log.info("catalogue: %s", line)
        self.differences += found

    # behind the service ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to read the tests that wait, the newest first."""
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.is_set():
            with self._turn:
                test_id = next(iter(self._waiting), None)
            if test_id is None:
                break
            began = time.thread_time()
            try:
                self.read(test_id)
            except (StereorigError, OSError):
                _log.exception(
                    "test %s could not be read into the catalogue; it is tried again when it is asked for", test_id
                )
                if self._ending.wait(1.0):
                    return
            self._ending.wait(_REST * (time.thread_time() - began))
        for entry in sorted((self._folder.root / "trash").glob("x*/content")):
            if self._ending.is_set():
                return
            finish_renaming(entry)

    def waiting(self) -> int:
        """Number of tests that are not read yet."""
        with self._turn:
            return len(self._waiting) + len(self._reading)

    def finish(self) -> None:
        """Read everything that waits, here and now."""
        while (test_id := next(iter(self._waiting), None)) is not None:
            self.read(test_id)

    def wait(self, seconds: float) -> None:
        """Wait for the end of the reading, but no longer than that."""
        with self._turn:
            self._turn.wait_for(lambda: not self._waiting and not self._reading, timeout=seconds)

    def close(self) -> bool:
        """End the reading; return True if the index is right about everything."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)
        return self._begun and self.waiting() == 0

    def leave_mark(self) -> None:
        """Write the mark of a clean stop; the catalogue is closed by now.

        Raises
        ------
        StorageError
            When the disk does not keep it.
        """
        leave_mark(self._catalog.path, [self._folder.tests / test_id for test_id in self._tests.ids()])


def _accept(folder: DataFolder) -> list[str]:
    """Take folders whose manifests were lost, or are older than the record, as they are; return a line for each."""
    done = []
    for home in sorted(
        path for kind in ("tests/t", "calibrations/c", "noise/n") for path in folder.root.glob(f"{kind}*")
    ):
        name = home.relative_to(folder.root)
        try:
            reason = differs_from(read_manifest(home), kept.anchors.get(home))
        except FileNotFoundError:
            if kept.anchors.pop(home, None) is not None:
                folder.manifests.settle(home, adopt=True)
                done.append(f"made the manifest of {name} from its files: it was gone")
        except DamagedError:
            continue  # verify names it
        else:
            if reason is not None:
                del kept.anchors[home]
                folder.manifests.put(home, {})
                done.append(f"took {name} as it is: its manifest {reason}")
    return done


def rebuild(
    catalog: Catalog,
    folder: DataFolder,
    calibrations: CalibrationStore,
    tests: TestStore,
    noise: NoiseStore | None = None,
) -> list[str]:
    """Make the index agree with the folders; also take over ids, Idempotency-Keys and ended jobs found there.

    Returns
    -------
    list of str
        Differences between index and folders, and files that cannot be read.
    """
    index = Index(catalog, folder, calibrations, tests, noise)
    index.begin(None)
    index.finish()
    return index.differences


def reindex(folder: DataFolder, *, believe: bool = False, accept: bool = False) -> list[str]:
    """Correct the catalogue of a data folder on which no service runs; return the differences, a line each.

    Parameters
    ----------
    believe
        After a clean stop, read only changed tests; else everything.
    accept
        Take a folder that was put back from a backup, or that lost its manifest, as it is from now on.
    """
    path = folder.root / "catalog.sqlite"
    known = take_mark(path)
    catalog = Catalog(path)
    catalog.unsettled = folder.manifests.unsettled
    catalog.open(sound=known is not None)
    try:
        was_reset = ["the catalogue could not be read; it was quarantined and replaced"] if catalog.was_reset else []
        was_reset += _accept(folder) if accept else []
        noise = NoiseStore(folder)
        noise.end_unfinished()
        index = Index(catalog, folder, CalibrationStore(folder), TestStore(folder), noise)
        index.begin(known if believe else None)
        index.finish()
    finally:
        catalog.close()
    if not catalog.write_failed:
        index.leave_mark()
    return was_reset + index.differences
