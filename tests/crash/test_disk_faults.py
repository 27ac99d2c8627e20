"""Every n-th write, fsync and rename fails once: nothing acknowledged is lost, nothing pretends to have been kept."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.errors import StorageError
from stereorig.server.formats import disk as disk_module
from stereorig.server.formats.images import encode_tiff
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import rebuild
from stereorig.server.store.noise import NoiseStore
from stereorig.server.store.repair import repair
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import verify
from tests.support.faulty_disk import WAYS, FaultyDisk, Way

MAX_CALLS = 400


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (24, 32)).astype(np.uint8)


class Session:
    """A lab's day: a calibration, noise, a test with steps and an analysis; keeps what was acknowledged."""

    def __init__(self, root: Path) -> None:
        self.folder = DataFolder(root).open()
        self.tests = TestStore(self.folder)
        self.calibrations = CalibrationStore(self.folder)
        self.noise = NoiseStore(self.folder)
        self.refused: list[StorageError] = []
        self.acknowledged: list[tuple[Path, str]] = []  # files and what they must hold

    def _ask(self, work: Callable[[], Any]) -> Any:
        """Do one thing as the service does; a failure is reported and not tried again."""
        try:
            return work()
        except StorageError as error:
            self.refused.append(error)
            return None

    def _keep(self, path: Path) -> None:
        self.acknowledged.append((path, hashlib.sha256(path.read_bytes()).hexdigest()))

    def run(self) -> None:
        calibration_id = self._ask(lambda: self.calibrations.create({"label": "c"}, {"pitch_mm": 1.0}))
        if calibration_id is not None:
            self._keep(self.calibrations.path(calibration_id) / "plan.json")
            views = [
                self._ask(lambda i=i: self.calibrations.put_view(calibration_id, i, "cam1", image(i))) for i in range(2)
            ]
            if None not in views:
                self._ask(lambda: self.calibrations.put_views_done(calibration_id, [dict(v) for v in views]))
        noise_id = self._ask(lambda: self.noise.create({"frames": 1}))
        if noise_id is not None:
            self._ask(lambda: self.noise.put_frame(noise_id, 0, "cam1", image(5)))
        made = self._ask(lambda: self.tests.create({"name": "one"}, None))
        if made is None:
            return
        test_id = made.id
        self._keep(self.tests.path(test_id) / "test.json")
        for k in range(4):
            images = {cam: encode_tiff(image(10 * k + int(cam[-1]))) for cam in ("cam1", "cam2")}
            step = self._ask(lambda k=k, images=images: self.tests.steps.add(test_id, images, {"label": f"load {k}"}))
            if step is not None:
                folder = self.tests.path(test_id) / "steps" / f"{step.n:04d}"
                for name in ("cam1.tif", "cam2.tif", "step.json"):
                    self._keep(folder / name)
                assert step.sha256 == {cam: hashlib.sha256(images[cam]).hexdigest() for cam in images}
        updated = self._ask(lambda: self.tests.update(test_id, {"name": "renamed"}))
        self.acknowledged = [pair for pair in self.acknowledged if pair[0].name != "test.json"]
        # a change that was refused may be there or not (the rename was made, its fsync failed), but never half
        assert self.tests.read(test_id).name in ({"renamed"} if updated is not None else {"one", "renamed"})
        if updated is not None:  # of one that was refused the next start may finish the renaming
            self._keep(self.tests.path(test_id) / "test.json")
        analysis = self._ask(lambda: self.tests.analyses.create(test_id, {"settings": {}}, mask=b"no picture"))
        if analysis is not None:
            self._ask(lambda: self.tests.analyses.put_summary(test_id, analysis.id, {"steps": []}))


@pytest.mark.normal_depth("full", "write_error")
@pytest.mark.fault(3)
@pytest.mark.parametrize("way", WAYS)
def test_every_call_that_can_fail_fails_once(way: Way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for n in range(1, MAX_CALLS):
        root = tmp_path / f"{n}"
        session = Session(root)
        faulty = FaultyDisk(way, n)
        monkeypatch.setattr(disk_module, "disk", faulty)
        session.run()
        monkeypatch.undo()
        session.folder.close()
        if not faulty.failed:
            assert not session.refused
            break
        assert session.refused, f"call {n} failed unseen"
        for error in session.refused:
            assert error.code == ("storage_full" if way in ("full", "short_write") else "storage_failed")
            assert error.remedy
        for path, sha256 in session.acknowledged:
            assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256, (n, path)
        assert verify(root).sound, (n, verify(root).findings)
        # the next start finds a folder that it can go on with
        outcome = repair(root)
        assert outcome.after.sound
        for path, sha256 in session.acknowledged:
            assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256, (n, path)
    else:
        raise AssertionError("the session has more calls than the test tries")
    assert n > 5
    print(f"{way}: {n - 1} calls")


def add_steps(tests: TestStore, test_id: str, images: dict[str, bytes]) -> None:
    for _ in range(5):
        tests.steps.add(test_id, images, {})


@pytest.mark.fault(3)
def test_after_the_disk_has_room_again_the_same_test_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = DataFolder(tmp_path / "data").open()
    tests = TestStore(folder)
    test_id = tests.create({"name": "one"}, None).id
    images = {cam: encode_tiff(image(int(cam[-1]))) for cam in ("cam1", "cam2")}
    for n in range(1, 8):
        monkeypatch.setattr(disk_module, "disk", FaultyDisk("full", n))
        with pytest.raises(StorageError):
            add_steps(tests, test_id, images)
        monkeypatch.undo()
        assert tests.steps.add(test_id, images, {}).n == tests.steps.numbers(test_id)[-1]
    numbers = tests.steps.numbers(test_id)
    assert numbers == list(range(len(numbers))), "no number is lost to a full disk"
    catalog = Catalog(folder.root / "catalog.sqlite").open()
    rebuild(catalog, folder, CalibrationStore(folder), tests)
    catalog.close()
    folder.close()
    assert verify(tmp_path / "data").findings == ()
