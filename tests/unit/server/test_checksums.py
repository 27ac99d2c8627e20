"""A flipped bit in a calibration, a view or a noise measurement is named, and hurts nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.noise_json import write_noise
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import rebuild
from stereorig.server.store.noise import NoiseStore
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import verify


def flip(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))


def image() -> np.ndarray:
    return np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)


@pytest.mark.fault(4)
def test_only_what_was_changed_is_refused_and_the_next_service_still_starts(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path / "data").open()
    calibrations, noise = CalibrationStore(folder), NoiseStore(folder)
    bad, good = (calibrations.add_imported({"label": ""}, {"baseline_mm": 400.25}) for _ in range(2))
    noises = [noise.create({"frames": 2, "label": ""}) for _ in range(2)]
    for noise_id in noises:
        write_noise(noise.path(noise_id) / "noise.json", {"gain": 1.25}, checksum=True)
    taken = calibrations.create({"label": ""}, {})
    views = [{"camera": "cam1", **calibrations.put_view(taken, k, "cam1", image())} for k in range(2)]
    calibrations.put_views_done(taken, views)
    assert verify(folder.root).sound
    assert calibrations.view_file(taken, 0, "cam1").is_file()

    changed = {
        f"calibrations/{bad}/calibration.json": (b"400.25", b"400.35"),
        f"noise/{noises[0]}/noise.json": (b"1.25", b"1.35"),
        f"calibrations/{taken}/views/000_cam1.tif": (b"\x10\x11", b"\x10\x13"),
    }
    for path, (old, new) in changed.items():
        flip(folder.root / path, old, new)
    for read in (
        lambda: calibrations.read(bad),
        lambda: noise.read(noises[0]),
        lambda: noise.file(noises[0]),
        lambda: calibrations.view_file(taken, 0, "cam1"),
    ):
        with pytest.raises(FileFormatError) as caught:
            read()
        assert caught.value.code == "checksum_mismatch"
        assert any(str(caught.value.context["file"]) == path for path in changed)
    assert {f.path for f in verify(folder.root).findings if f.level == "damaged"} == set(changed)
    assert calibrations.read(good).plain()["baseline_mm"] == 400.25
    assert noise.read(noises[1]).plain()["gain"] == 1.25
    assert calibrations.view_file(taken, 1, "cam1").is_file()

    folder.close()
    folder = DataFolder(tmp_path / "data").open()
    catalog = Catalog(folder.root / "catalog.sqlite").open()
    lines = rebuild(catalog, folder, CalibrationStore(folder), TestStore(folder), NoiseStore(folder))
    assert any(bad in line and "checksum" in line for line in lines)
    assert [entry["id"] for entry in catalog.entries("calibration")] == [good, taken]
    catalog.close()
    folder.close()


@pytest.mark.fault(4)
def test_a_step_whose_document_cannot_be_read_takes_no_other_with_it(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path / "data").open()
    tests = TestStore(folder)
    test_id = tests.create({"name": "one"}, None).id
    for _ in range(4):
        tests.steps.add(test_id, {"cam1": b"1", "cam2": b"2"}, {})
    (tests.path(test_id) / "steps" / "0001" / "step.json").write_text('{"n": 1, ')
    catalog = Catalog(folder.root / "catalog.sqlite").open()
    lines = rebuild(catalog, folder, CalibrationStore(folder), tests)
    assert any("step 1 of test" in line for line in lines)
    assert [entry["n"] for entry in catalog.entries("step", test_id)] == [0, 2, 3]
    catalog.close()
    folder.close()
