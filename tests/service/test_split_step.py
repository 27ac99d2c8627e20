"""One step split by region over workers: the field of one worker, to the last bit."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.field.points.result import Field
from core.field.sequence.joint import AGREE_SIGMAS
from core.settings import StoredSettings
from server.compute.sequence import SequenceMeasurement
from server.compute.tiles.folder_crew import FolderCrew
from server.formats.calibrations.recognise import load_calibration
from server.formats.files import sha256_of
from server.worker.embedded import ComputeWorker
from server.worker.executor import TaskFuture, WorkerDiedError
from server.worker.helpers import Helpers
from server.worker.tasks import StepImages
from server.worker.tile_task import TileTask, fit_tiles
from tests.support import sequence_bench as bench
from tests.support.copied_tests import write_test_of
from tests.support.dask_bench import Host, cluster_of
from tests.support.running_analyses import API, begin, contents, folder_of
from tests.support.service_rig import wait_for_job

TEST = "t000001-abcdef"
URL = f"{API}/tests/{TEST}"
STEPS = 3
HOLE = [[200, 170], [235, 165], [240, 205], [205, 210]]
CRACK = [[300, 130], [310, 240], [330, 330]]
BODY: dict[str, Any] = {
    "region": {"rectangle": [130, 120, 390, 360], "holes": [HOLE], "cracks": [CRACK]},
    "subset_px": 33,
    "spacing_px": 5,
    "split_step": "always",
}
LOST = (slice(250, 320), slice(150, 230))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate that turns, moves and stretches; in the last step something lies on it."""
    folder = tmp_path_factory.mktemp("data")
    images = []
    for n in range(STEPS):
        scene = bench.plate(0.4 * n, np.array([0.03, -0.02, 0.02]) * n, np.diag([1 + 0.003 * n, 1 - 0.001 * n]))
        images.append(bench.capture(scene, seed=n))
    for image in images[-1]:
        image[LOST] = np.random.default_rng(9).integers(100, 120, image[LOST].shape)
    write_test_of(folder / "tests" / TEST, bench.rig().pair, iter(images))
    return folder


@pytest.fixture(scope="module")
def worker() -> Iterator[ComputeWorker]:
    """A worker that helps."""
    made = ComputeWorker(threads=1, lowered=False)
    made.start()
    yield made
    made.shutdown()


def wait_until(there: Callable[[], bool], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.005)


class Called:
    """Calls workers, and waits for their first tiles before the step goes on."""

    def __init__(self, worker: ComputeWorker, tiles: int = 2) -> None:
        self.worker, self.tiles = worker, tiles
        self.futures: list[TaskFuture] = []
        self.fitted: list[int] = []

    def __call__(self, task: TileTask) -> bool:
        self.futures.append(self.worker.submit(fit_tiles, task))
        wait_until(lambda: len(list(task.folder.glob("fits_*"))) >= self.tiles)
        self.fitted.append(len(list(task.folder.glob("fits_*"))))
        return True


def sequence_of(data: Path, folder: Path, call: Callable[[TileTask], bool] | None, **changes: Any) -> list[Field]:
    """Measure all steps in this process."""
    test = data / "tests" / TEST
    settings = StoredSettings.model_validate({**BODY, **changes})

    def step(n: int) -> StepImages:
        one, two = (test / "steps" / f"{n:04d}" / f"{cam}.tif" for cam in ("cam1", "cam2"))
        return StepImages(n=n, files=(one, two), sha256=(sha256_of(one), sha256_of(two)))

    folder.mkdir(exist_ok=True)
    calibration = test / "calibration.json"
    crew = None if call is None else FolderCrew(folder, calibration, call)
    measuring = SequenceMeasurement(
        calibration=load_calibration(calibration),
        settings=settings,
        mask=None,
        reference=step(0),
        folder=folder,
        crew=crew,
    )
    previous = [None, None, 1]
    found = [measuring.measure(step(n), previous=previous[n], shares=True) for n in range(STEPS)]
    assert list(folder.glob(".tiles*")) == []
    return found


def assert_same(found: list[Field], expected: list[Field]) -> None:
    for n, (one, two) in enumerate(zip(found, expected, strict=True)):
        for f in fields(Field):
            if isinstance(getattr(two, f.name), np.ndarray):
                np.testing.assert_array_equal(getattr(one, f.name), getattr(two, f.name), err_msg=f"{n}, {f.name}")


@pytest.fixture(scope="module")
def alone(data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Field]:
    """What one worker measures."""
    return sequence_of(data, tmp_path_factory.mktemp("alone"), None)


def test_a_shape_a_first_motion_and_a_further_step_are_those_of_one_worker(
    data: Path, tmp_path: Path, worker: ComputeWorker, alone: list[Field]
) -> None:
    called = Called(worker)
    assert_same(sequence_of(data, tmp_path / "a", called), alone)
    assert len(called.fitted) >= STEPS
    for future in called.futures:
        assert future.result(timeout=30) >= 0  # a tile that nobody wanted any more is no failure


@pytest.mark.deep
@pytest.mark.parametrize("changes", [{"patch": "quadratic"}, {"keep_rejected": True}])
def test_so_they_are_with_other_patches_and_what_was_rejected(
    data: Path, tmp_path: Path, worker: ComputeWorker, changes: dict[str, Any]
) -> None:
    changes = {**changes, "spacing_px": 8}
    expected = sequence_of(data, tmp_path / "b", None, **changes)
    assert_same(sequence_of(data, tmp_path / "a", Called(worker, 1), **changes), expected)


def test_the_scene_has_a_hole_a_crack_and_a_part_that_is_lost(alone: list[Field]) -> None:
    shape, _, last = alone
    assert shape.cuts is not None
    assert 0.9 < shape.valid.mean() < 0.99  # the rest lies in the hole
    inside = (
        (shape.x_px > LOST[1].start + 20)
        & (shape.x_px < LOST[1].stop - 25)
        & (shape.y_px > LOST[0].start + 20)
        & (shape.y_px < LOST[0].stop - 20)
    )
    assert shape.valid[inside].all()
    assert not last.valid[inside].any()
    assert last.valid.mean() > 0.5


def test_in_one_piece_the_points_are_the_same_and_the_values_within_their_uncertainty(
    data: Path, tmp_path: Path, alone: list[Field]
) -> None:
    for one, two in zip(sequence_of(data, tmp_path / "a", None, split_step="never"), alone, strict=True):
        np.testing.assert_array_equal(one.status, two.status)
        a, b = (f.xyz_mm if f.uvw_mm is None else f.uvw_mm for f in (one, two))
        off = ((a - b) / one.sigma_mm[..., -3:])[one.valid]
        assert np.sqrt(np.mean(off**2)) < AGREE_SIGMAS


def test_tiles_of_a_worker_that_dies_are_taken_again(data: Path, tmp_path: Path, alone: list[Field]) -> None:
    dying = ComputeWorker(threads=1, lowered=False)
    dying.start()
    futures: list[TaskFuture] = []

    def call(task: TileTask) -> bool:
        if futures:
            return True
        futures.append(dying.submit(fit_tiles, task))
        wait_until(lambda: next(task.folder.glob("taken_*"), None) is not None)
        assert dying.pid is not None
        os.kill(dying.pid, signal.SIGKILL)
        with pytest.raises(WorkerDiedError):
            futures[-1].result(timeout=60)
        return True

    try:
        assert_same(sequence_of(data, tmp_path / "a", call), alone)
    finally:
        dying.shutdown()
    assert len(futures) == 1


def test_tiles_of_a_worker_that_cannot_read_the_images_are_fitted_by_who_wanted_them(
    data: Path, tmp_path: Path, worker: ComputeWorker, alone: list[Field]
) -> None:
    futures = []

    def call(task: TileTask) -> bool:
        gone = tuple(path.with_name("gone.tif") for path in task.images)
        futures.append(worker.submit(fit_tiles, replace(task, images=gone)))
        with pytest.raises(OSError, match="gone"):
            futures[-1].result(timeout=60)
        return True

    assert_same(sequence_of(data, tmp_path / "a", call), alone)
    assert len(futures) >= STEPS


# through the service -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def host(data: Path) -> Iterator[Host]:
    """A service with two processes of its own for analyses."""
    made = Host(data, "[compute]\nprocesses = 2")
    yield made
    made.close()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[TileTask]:
    """Calls for help that the service has heard."""
    heard: list[TileTask] = []
    hear = Helpers.hear

    def noted(helpers: Helpers, future: TaskFuture) -> None:
        hear(helpers, future)
        on_call = future.on_call
        assert on_call is not None

        def called(task: TileTask) -> None:
            heard.append(task)
            on_call(task)

        future.on_call = called

    monkeypatch.setattr(Helpers, "hear", noted)
    return heard


def measured(host: Host, **changes: Any) -> list[dict[str, Any]]:
    url, job = begin(host.client, URL, **{**BODY, **changes})
    done = wait_for_job(host.client, job, seconds=300.0)
    assert done["state"] == "succeeded", done["problem"]
    folder = folder_of(host, url)
    assert list(folder.glob(".tiles*")) == []
    return [contents(folder / f"step_{n:04d}.nc") for n in range(STEPS)]


def copy_of(data: Path, folder: Path) -> Path:
    """A data folder with the test and without its analyses: a service has its own."""
    shutil.copytree(data / "tests", folder / "tests", ignore=shutil.ignore_patterns("a0*"))
    return folder


def test_a_service_with_two_workers_writes_what_one_worker_does(
    data: Path, host: Host, calls: list[TileTask], tmp_path: Path
) -> None:
    two = measured(host, spacing_px=7)
    assert np.isfinite(two[1]["exx"]).any()
    before = len(calls)
    assert before >= STEPS
    single = Host(copy_of(data, tmp_path / "one"), "")
    try:
        one = measured(single, spacing_px=7)
    finally:
        single.close()
    assert len(calls) == before  # nobody is there to be called
    for n, (a, b) in enumerate(zip(one, two, strict=True)):
        assert a.keys() == b.keys()
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=f"{n}, {name}")


@pytest.mark.deep
def test_workers_of_a_cluster_write_what_one_worker_does(data: Path, calls: list[TileTask], tmp_path: Path) -> None:
    with cluster_of(2, tmp_path) as cluster:
        cluster.await_workers(2)
        there = Host(copy_of(data, tmp_path / "two"), f'[compute]\nscheduler = "{cluster.address}"')
        single = Host(copy_of(data, tmp_path / "one"), "")
        try:
            two, one = measured(there), measured(single)
        finally:
            there.close()
            single.close()
    assert len(calls) >= STEPS
    for n, (a, b) in enumerate(zip(one, two, strict=True)):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=f"{n}, {name}")


def test_who_asks_for_one_piece_calls_nobody(host: Host, calls: list[TileTask]) -> None:
    measured(host, spacing_px=12, split_step="never")
    measured(host, spacing_px=12, split_step="auto")  # as small a step
    assert calls == []


def test_a_job_that_is_cancelled_leaves_no_tiles_and_its_workers_free(host: Host, calls: list[TileTask]) -> None:
    url, job = begin(host.client, URL, **{**BODY, "spacing_px": 2})
    wait_until(lambda: len(calls) > 0)
    assert host.client.post(f"{API}/jobs/{job['id']}/cancel").status_code == 202
    assert wait_for_job(host.client, job)["state"] == "cancelled"
    wait_until(lambda: list(folder_of(host, url).glob(".tiles*")) == [], 10.0)
    measured(host, spacing_px=12)
