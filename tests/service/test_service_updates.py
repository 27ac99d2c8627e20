"""Reference update in the service: what was asked for is recorded, and a fresh worker goes on from the files."""

from __future__ import annotations

import hashlib
import itertools
import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from stereorig.core.errors import FileFormatError, StereorigError, StorageError
from stereorig.core.field.points.result import Field
from stereorig.server.api.models import AnalysisRequest
from stereorig.server.compute import measurement, sequence
from stereorig.server.compute.sequence import SequenceMeasurement
from stereorig.server.compute.tasks import StepImages, StepTask
from stereorig.server.formats.images import write_image
from stereorig.server.worker.process import TaskChannel
from tests.support import sequence_bench as bench

STEPS = (3, 4, 6, 7)  # as a test numbers them, one is missing


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    for k, n in enumerate(STEPS):
        scene = bench.plate(0.3 * k, np.array([0.021, -0.013, 0.02]) * k)
        for cam, image in zip(("cam1", "cam2"), bench.capture(scene, seed=k), strict=True):
            write_image(folder / f"{cam}_{n}.tif", image)
    cameras = (bench.rig().pair.cam1, bench.rig().pair.cam2)
    document = {cam: c.paper_parameters() for cam, c in zip(("cam1", "cam2"), cameras, strict=True)}
    (folder / "calibration.json").write_text(json.dumps(document))
    return folder


def tasks(inputs: Path, out: Path, **settings: Any) -> list[StepTask]:
    """The tasks of an analysis, as the service makes them."""
    out.mkdir()
    body = AnalysisRequest.model_validate(
        {"region": {"rectangle": [190, 180, 330, 300]}, "spacing_px": 14, "patch": "affine", "strain": None, **settings}
    )
    steps = {}
    for n in STEPS:
        paths = inputs / f"cam1_{n}.tif", inputs / f"cam2_{n}.tif"
        one, two = (hashlib.sha256(path.read_bytes()).hexdigest() for path in paths)
        steps[n] = StepImages(n=n, files=paths, sha256=(one, two))
    return [
        StepTask(
            folder=out,
            calibration=inputs / "calibration.json",
            settings=body.stored(),
            reference=steps[STEPS[0]],
            step=steps[n],
            previous=STEPS[k - 1] if k else None,
            earlier={m: steps[m] for m in STEPS[1:k]},
        )
        for k, n in enumerate(STEPS)
    ]


def test_a_fresh_worker_goes_on_from_the_files(inputs: Path, tmp_path: Path) -> None:
    one, fresh = (tasks(inputs, tmp_path / name, reference_update="always") for name in ("one", "fresh"))
    summaries = [measurement.measure_step(task) for task in one]
    assert [s.get("reference_step") for s in summaries] == [None, 3, 4, 6]
    for k, task in enumerate(fresh):
        (tmp_path / "fresh" / f"step_{STEPS[k]:04d}.nc").unlink(missing_ok=True)
        if k < 2:  # what was measured before the worker was lost
            source = tmp_path / "one" / f"step_{STEPS[k]:04d}.nc"
            (tmp_path / "fresh" / source.name).write_bytes(source.read_bytes())
            continue
        measurement._kept.clear()
        measurement.measure_step(task)
        with (
            xr.open_dataset(tmp_path / "one" / f"step_{STEPS[k]:04d}.nc") as a,
            xr.open_dataset(tmp_path / "fresh" / f"step_{STEPS[k]:04d}.nc") as b,
        ):
            assert a.attrs["reference_step"] == b.attrs["reference_step"] == STEPS[k - 1]
            for name in ("u_mm", "v_mm", "w_mm", "stretch_11", "sigma_u_mm", "propagated_noise_xx_px2", "status"):
                np.testing.assert_allclose(a[name], b[name], rtol=1e-5, atol=1e-9, err_msg=name)
            assert json.loads(a.attrs["settings"])["reference_update"] == "always"
            # a file written anew by another program is no reference any more
    document = fresh[3]
    spoiled = replace(document, earlier={6: replace(document.earlier[6], sha256=("0" * 64, "0" * 64))})
    measurement._kept.clear()
    with pytest.raises(FileFormatError, match="checksum"):
        measurement.measure_step(spoiled)
    measurement._kept.clear()


def test_smoothed_files_still_tell_what_was_measured(inputs: Path, tmp_path: Path) -> None:
    made = tasks(inputs, tmp_path / "smooth", reference_update="always", smoothing_window=3)
    for task in made[:3]:
        measurement.measure_step(task)
    known = measurement.measure_step(made[3])["displacement_mm"]
    measurement._kept.clear()
    again = measurement.measure_step(made[3])["displacement_mm"]
    measurement._kept.clear()
    for name in "uvw":
        assert again[name]["mean"] == pytest.approx(known[name]["mean"], abs=1e-8)


def test_the_default_is_auto() -> None:
    body = AnalysisRequest.model_validate({"region": {"rectangle": [0, 0, 9, 9]}})
    assert body.reference_update == "auto"
    with pytest.raises(ValueError, match="reference_update"):
        AnalysisRequest.model_validate({"region": {"rectangle": [0, 0, 9, 9]}, "reference_update": "often"})


def test_a_step_that_was_begun_before_it_was_asked_for_is_the_same(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, made = (tasks(inputs, tmp_path / name, reference_update="always") for name in ("plain", "ahead"))
    for task in plain:
        measurement.measure_step(task)
    measurement._kept.clear()
    monkeypatch.setattr(measurement, "current_task", lambda: TaskChannel(lambda _: None, 0, None, keeps_going=True))
    threads: list[str] = []
    measure = SequenceMeasurement.measure

    def noted(self: SequenceMeasurement, *args: Any, **more: Any) -> Field:
        threads.append(threading.current_thread().name)
        return measure(self, *args, **more)

    monkeypatch.setattr(SequenceMeasurement, "measure", noted)
    following = [replace(task, following=after.step) for task, after in itertools.pairwise(made)] + made[-1:]
    for task in following:
        measurement.measure_step(task)
    assert [name.startswith("stereorig-ahead") for name in threads] == [False, True, True, True]
    for n in STEPS:
        with (
            xr.open_dataset(tmp_path / "plain" / f"step_{n:04d}.nc") as a,
            xr.open_dataset(tmp_path / "ahead" / f"step_{n:04d}.nc") as b,
        ):
            for name in a.variables:
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    # another step is asked for than was begun: as after a step that failed
    measurement.measure_step(following[1])
    threads.clear()
    measurement.measure_step(following[3])
    assert not threads[-1].startswith("stereorig-ahead")
    measurement._kept.clear()


def test_a_step_begun_ahead_gives_its_error_to_the_task_that_asks_for_it(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tasks(inputs, tmp_path / "broken", reference_update="never")
    monkeypatch.setattr(measurement, "current_task", lambda: TaskChannel(lambda _: None, 0, None, keeps_going=True))
    missing = replace(made[1].step, files=(tmp_path / "none.tif", made[1].step.files[1]))
    summary = measurement.measure_step(replace(made[0], following=missing))
    assert summary["valid"] > 0  # the step itself is measured and written
    with pytest.raises(StereorigError, match=r"none\.tif"):
        measurement.measure_step(replace(made[1], step=missing))
    assert measurement.measure_step(replace(made[1], previous=STEPS[0]))["valid"] > 0
    # a full disk stops the step that is written, and what was begun after it
    full = StorageError("The disk is full.", code="storage_full", remedy="Free some.")

    def refuse(*_: object, **__: object) -> None:
        raise full

    monkeypatch.setattr(sequence, "write_field", refuse)
    with pytest.raises(StorageError):
        measurement.measure_step(replace(made[2], following=made[3].step))
    assert measurement._ahead._begun is None
    measurement._kept.clear()
