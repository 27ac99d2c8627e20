"""`stereorig doctor`: a good bench is reported good, and each fault is found, named and rated."""

from __future__ import annotations

import itertools
import json
import shutil
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stereorig.sim.grabber
from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.server.cli import main
from stereorig.server.doctor import AllChecks, Check, examine
from stereorig.server.doctor.disk import check_disk
from stereorig.server.doctor.machine import check_machine
from stereorig.server.doctor.report import Notebook, line_of, percentile
from stereorig.server.doctor.stage import check_stage
from stereorig.server.store.folder import DataFolder
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.grabber import SimFrameGrabber
from tests.support.patience import busy
from tests.support.service_rig import TINY, tiny_config
from tests.support.stage_bench import CONTROLLERS, Bench, bench

# the machine's own matters, which depend on where the tests run
HERE = {
    ("service", "port"),
    ("machine", "processors"),
    ("machine", "load"),
    ("machine", "memory"),
    ("machine", "clock"),
}


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def diagnose(rig: Path, **options: Any) -> AllChecks:
    return examine(rig, seconds=0.3, data=rig.parent / "data", **options)


def check_of(checks: AllChecks | list[Check], part: str, name: str) -> Check:
    found = [
        c for c in (checks.checks if isinstance(checks, AllChecks) else checks) if (c.part, c.name) == (part, name)
    ]
    assert len(found) == 1, (part, name, found)
    return found[0]


def spoil(monkeypatch: pytest.MonkeyPatch, cam: str, harm: Callable[[SimFrameGrabber], None]) -> None:
    """Have the rig's simulated camera opened with something wrong."""

    class Spoilt(SimFrameGrabber):
        def __init__(self, world: Any, name: Any, **options: Any) -> None:
            super().__init__(world, name, **options)
            if name == cam:
                harm(self)

    monkeypatch.setattr(stereorig.sim.grabber, "SimFrameGrabber", Spoilt)


# the whole -------------------------------------------------------------------------------------------------------


def test_a_good_bench_is_called_good(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--config", str(rig), "--seconds", "0.3", "--data", str(rig.parent), "--json"]) == 0
    report = AllChecks.model_validate_json(capsys.readouterr().out)
    assert report.good
    assert report.rig == "tiny rig"
    for check in report.checks:
        if (check.part, check.name) not in HERE:
            assert check.state == "ok", check
            assert check.remedy is None
    parts = {(check.part, check.name) for check in report.checks}
    assert parts >= {
        ("rig file", "reading"),
        ("software", "packages"),
        ("machine", "clock steps"),
        ("cam1", "identity"),
        ("cam2", "settings"),
        ("cam1", "frame rate"),
        ("cam2", "losses"),
        ("cam1", "image"),
        ("pairs", "skew"),
        ("pairs", "account"),
        ("pairs", "latency"),
        ("pairs", "rate"),
        ("stage", "identity"),
        ("stage", "axis 2 state"),
        ("stage", "axis 1 limits"),
        ("stage", "answers"),
        ("stage", "stop"),
        ("stage", "axis 1 move"),
        ("disk", "writing"),
        ("disk", "room"),
        ("disk", "data folder"),
    }
    assert not list(rig.parent.glob(".doctor-*"))


def test_text_has_a_line_for_each_check_and_the_verdict_last(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--config", str(rig), "--seconds", "0.2", "--data", str(rig.parent)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("GOOD: none of")
    assert any(line.startswith("ok          pairs skew") and "[limit: 1 ms" in line for line in lines)


def test_a_rig_file_that_cannot_be_read_fails_but_the_machine_is_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(TINY.replace("max_skew_ms = 1.0", "max_skew_mms = 1.0"))
    report = diagnose(path)
    assert not report.good
    assert report.rig is None
    assert "max_skew_mms" in check_of(report, "rig file", "reading").found
    assert check_of(report, "disk", "writing").state == "ok"
    assert report.verdict.startswith("NOT GOOD: 1 of")
    assert main(["doctor", "--config", str(tmp_path / "none.toml"), "--data", str(tmp_path)]) == 1


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf"])
def test_a_time_that_is_none_is_refused(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", f"--seconds={seconds}"]) == 1
    assert "invalid_input" in capsys.readouterr().err


def test_the_wire_is_written_down(rig: Path) -> None:
    wire = rig.parent / "wire.txt"
    options = ["--config", str(rig), "--seconds", "0.2", "--data", str(rig.parent), "--record", str(wire)]
    assert main(["doctor", *options]) == 0
    assert "VE?" in wire.read_text()
    options[-1] = str(rig.parent / "nowhere" / "wire.txt")
    assert main(["doctor", *options]) == 1


def test_a_port_that_another_program_holds_is_named(rig: Path) -> None:
    controller = make_controller("esp301", (1, 2), travel_mm=(-12.0, 12.0))
    with ControllerServer(controller, "pty") as line:
        rig.write_text(TINY.replace('url = "sim"', f'url = "{line.url}"'))
        script = "import os, sys; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print('held', flush=True); input()"
        with subprocess.Popen(
            [sys.executable, "-c", script, line.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as other:
            assert other.stdout is not None
            other.stdout.readline()
            held = diagnose(rig)
            other.communicate("\n")
        assert f"process {other.pid}" in check_of(held, "stage", "port").found
        assert not held.good
        assert check_of(diagnose(rig), "stage", "port").state == "ok"


def test_a_real_stage_behind_simulated_cameras_does_not_move(rig: Path) -> None:
    controller = make_controller("esp301", (1, 2), travel_mm=(-12.0, 12.0))
    with ControllerServer(controller) as line:
        rig.write_text(TINY.replace('url = "sim"', f'url = "{line.url}"'))
        report = diagnose(rig)
    assert report.good
    assert not controller.commands("OR")
    assert not controller.commands("PA")
    assert check_of(report, "stage", "axis 1 move").state == "not checked"


# cameras --------------------------------------------------------------------------------------------------------


def test_a_camera_that_another_program_holds_is_named(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, "cam2", lambda camera: setattr(camera.faults, "busy", True))
    report = diagnose(rig)
    assert not report.good
    opening = check_of(report, "cam2", "opening")
    assert "camera_busy" in opening.found
    assert opening.remedy is not None


@pytest.mark.parametrize(("often", "state"), [(False, "warning"), (True, "failed")])
def test_skew_above_the_limit_is_measured_and_judged(
    rig: Path, monkeypatch: pytest.MonkeyPatch, often: bool, state: str
) -> None:
    rig.write_text(TINY.replace("max_skew_ms = 1.0", "max_skew_ms = 2.0"))
    delays = itertools.cycle([0.5, 0.5, 2.5]) if often else iter([0.5, 2.5])

    class Uneven(SimFrameGrabber):
        def trigger(self) -> int | None:
            if self._cam == "cam2":
                self.faults.skew_ms = next(delays, 0.5)
            return super().trigger()

    monkeypatch.setattr(stereorig.sim.grabber, "SimFrameGrabber", Uneven)
    report = examine(rig, seconds=1.5, data=rig.parent)  # the first picture takes its time
    skew = check_of(report, "pairs", "skew")
    assert skew.state == state
    assert skew.figures["median_ms"] == pytest.approx(0.5, abs=1e-6)
    assert skew.figures["worst_ms"] == pytest.approx(2.5, abs=1e-6)
    assert (skew.figures["refused"] == 1) != often
    assert skew.limit is not None
    assert skew.limit.startswith("2 ms")
    assert report.good != often


def test_a_camera_that_falls_silent_fails_and_the_stage_is_still_examined(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silence(camera: SimFrameGrabber) -> None:
        camera.faults.silent = True
        # not the half minute that a first picture may take to be made
        camera._description = replace(camera._description, latency_s=0.0)

    spoil(monkeypatch, "cam1", silence)
    report = diagnose(rig)
    assert "silent" in check_of(report, "cam1", "frames").found
    assert check_of(report, "stage", "answers").state == "ok"
    assert check_of(report, "disk", "writing").state == "ok"
    assert not report.good


def test_damaged_frames_are_counted(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, "cam1", lambda camera: setattr(camera.faults, "incomplete", 10**6))
    report = diagnose(rig)
    assert not report.good
    some = [check for check in report.checks if check.part in ("cam1", "pairs") and check.state == "failed"]
    assert any("incomplete" in check.found for check in some)


def test_one_damaged_frame_in_many_is_a_warning(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = itertools.count(1)

    class Once(SimFrameGrabber):
        def trigger(self) -> int | None:
            if self._cam == "cam1" and next(calls) == 3:
                self.faults.incomplete = 1
            return super().trigger()

    monkeypatch.setattr(stereorig.sim.grabber, "SimFrameGrabber", Once)
    report = examine(rig, seconds=2.0, data=rig.parent)
    losses = check_of(report, "cam1", "losses")
    assert losses.figures["incomplete"] == 1
    assert losses.state == "warning"
    assert check_of(report, "cam2", "losses").state == "ok"


def test_a_setting_that_the_device_bends_fails(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Bends(SimFrameGrabber):
        def configure(self, settings: CameraSettings) -> CameraSettings:
            return replace(super().configure(settings), exposure_ms=8.0, gain_db=0.0)

    monkeypatch.setattr(stereorig.sim.grabber, "SimFrameGrabber", Bends)
    report = diagnose(rig)
    settings = check_of(report, "cam1", "settings")
    assert settings.state == "failed"
    assert "exposure_ms 8.0 instead of 10.0" in settings.found
    assert not report.good


@pytest.mark.parametrize(("light", "code"), [(0.001, "dark"), (5.0, "saturated")])
def test_black_and_saturated_images_are_warned_of(rig: Path, light: float, code: str) -> None:
    rig.write_text(TINY + f"gain = {light}\n")  # the file ends in camera 2's truth
    report = diagnose(rig)
    image = check_of(report, "cam2", "image")
    assert image.state == "warning"
    assert image.found.startswith(code)
    assert image.remedy is not None
    assert report.good  # the bench works; what is before it is another matter


def test_an_image_of_another_size_than_the_rig_file_says_fails(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crop(camera: SimFrameGrabber) -> None:
        camera._settings = replace(camera._settings, region_px=(0, 0, 64, 48))

    spoil(monkeypatch, "cam2", crop)
    report = diagnose(rig)
    failed = [check for check in report.checks if check.state == "failed"]
    assert any("cam2 delivers images of 64 x 48 px" in check.found for check in failed)
    assert not report.good


# stage ----------------------------------------------------------------------------------------------------------

OPTIONS = {axis: AxisOptions(soft_limits_mm=(-6.0, 6.0), backlash_mm=0.05) for axis in (1, 2)}


@pytest.fixture(params=CONTROLLERS)
def stage(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with bench(request.param, "socket", options=OPTIONS, travel_mm=(-12.0, 12.0), time_scale=20.0) as made:
        yield made


def moves_of(bench: Bench) -> int:
    return len(bench.controller.commands("PA") + bench.controller.commands("PR") + bench.controller.commands("OR"))


def test_a_real_stage_is_not_moved_unless_it_is_allowed(stage: Bench) -> None:
    book = Notebook()
    check_stage(book, stage.stage, tiny_config(), move=False, home=False)
    assert moves_of(stage) == 0
    assert check_of(book.checks, "stage", "axis 1 state").state == "warning"
    assert "--home" in str(check_of(book.checks, "stage", "axis 1 state").remedy)
    assert check_of(book.checks, "stage", "axis 2 move").state == "not checked"
    assert "--move" in str(check_of(book.checks, "stage", "axis 2 move").remedy)
    assert check_of(book.checks, "stage", "answers").state == "ok"


def test_a_stage_that_is_not_homed_is_not_moved_even_if_allowed(stage: Bench) -> None:
    book = Notebook()
    check_stage(book, stage.stage, tiny_config(), move=True, home=False)
    assert moves_of(stage) == 0
    assert check_of(book.checks, "stage", "axis 1 move").state == "not checked"


def test_allowed_moves_come_back_to_where_they_began(stage: Bench) -> None:
    stage.ready(1, 2)
    before = stage.stage.position(1)
    book = Notebook()
    check_stage(book, stage.stage, tiny_config(), move=True, home=False)
    assert check_of(book.checks, "stage", "axis 1 move").state == "ok"
    assert stage.axis(1).true_position_mm() == pytest.approx(before, abs=0.002)
    assert len(stage.controller.commands("PA")) >= 4


def test_a_plan_beyond_the_limits_fails(stage: Bench) -> None:
    book = Notebook()
    plan = tiny_config(positions_mm="positions_mm = [0.0, 7.5]")
    check_stage(book, stage.stage, plan, move=False, home=False)
    limits = check_of(book.checks, "stage", "axis 2 limits")
    assert limits.state == "failed"
    assert "dZ 7.5 mm of cam2" in limits.found


def test_a_silent_controller_fails_and_nothing_hangs(stage: Bench) -> None:
    stage.controller.line_faults.deaf = True
    book = Notebook()
    check_stage(book, stage.stage, tiny_config(), move=False, home=False)
    assert "stage_lost" in check_of(book.checks, "stage", "answers").found
    assert not book.verdict()[0]


@pytest.mark.parametrize("stage", ["esp301"], indirect=True)
def test_slow_answers_are_warned_of(stage: Bench) -> None:
    patient = stage.another(OPTIONS)
    stage.controller.line_faults.delay_s = 0.12
    book = Notebook()
    check_stage(book, patient, tiny_config(), move=False, home=False)
    answers = check_of(book.checks, "stage", "answers")
    assert answers.state == "warning"
    assert 80.0 < float(answers.figures["median_ms"]) < 160.0 * busy()  # type: ignore[arg-type]
    assert check_of(book.checks, "stage", "stop").state == "warning"


# disk and machine -----------------------------------------------------------------------------------------------


def test_a_disk_that_cannot_keep_up_is_warned_of(tmp_path: Path) -> None:
    book = Notebook()
    check_disk(book, tmp_path, image_bytes=4096, pairs_per_s=1e9)
    writing = check_of(book.checks, "disk", "writing")
    assert writing.state == "warning"
    assert writing.figures["mib_per_s"] > 0  # type: ignore[operator]


def test_a_folder_that_takes_no_files_fails() -> None:
    book = Notebook()
    check_disk(book, Path("/proc/stereorig"), image_bytes=4096, pairs_per_s=None)
    assert check_of(book.checks, "disk", "writing").state == "failed"


def test_a_data_folder_in_use_names_its_holder(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path / "data").open()
    try:
        book = Notebook()
        check_disk(book, tmp_path / "data", image_bytes=4096, pairs_per_s=None)
    finally:
        folder.close()
    check = check_of(book.checks, "disk", "data folder")
    assert check.state == "warning"
    assert "process" in check.found


@pytest.mark.parametrize(("pairs", "state"), [(19, "failed"), (500, "warning"), (1000, "ok")])
def test_room_is_judged_in_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pairs: int, state: str) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(2**40, 0, pairs * 2 * 4096))
    book = Notebook()
    check_disk(book, tmp_path, image_bytes=4096, pairs_per_s=None)
    assert check_of(book.checks, "disk", "room").state == state


def test_the_machine_says_what_it_has() -> None:
    book = Notebook()
    check_machine(book)
    assert check_of(book.checks, "machine", "processors").figures["processors"] >= 1  # type: ignore[operator]
    assert check_of(book.checks, "machine", "memory").figures["available_gib"] > 0  # type: ignore[operator]


def test_percentiles_are_values_that_were_measured() -> None:
    values = list(np.random.default_rng(3).normal(size=57))
    for share in (0.01, 0.5, 0.9, 0.99, 1.0):
        assert percentile(values, share) == np.quantile(values, share, method="inverted_cdf")


def test_a_line_shows_remedy_only_where_there_is_something_to_do() -> None:
    book = Notebook()
    book.note("disk", "room", "ok", "fine", remedy="Free space.")
    book.note("disk", "room", "warning", "little", limit="much", remedy="Free space.", free_gib=1.0)
    assert "Free" not in line_of(book.checks[0])
    assert "-> Free space." in line_of(book.checks[1])
    assert json.loads(book.checks[1].model_dump_json())["figures"] == {"free_gib": 1.0}
