"""What the command line makes of patterns, regions, masks and seeds."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereorig.core.errors import FileFormatError, ImageError, InputError, RegionError
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.settings import SPACING_PX, SUBSET_PX, Outline
from stereorig.server.cli import main
from stereorig.server.cli.measurement.image_lists import expand, pair_up, pairs_of_test_folder
from stereorig.server.cli.measurement.region import (
    check_region,
    check_whole,
    parse_hole,
    parse_outline,
    parse_rectangle,
)
from stereorig.server.cli.terminal import ProgressLine, duration

SHAPE = (480, 512)


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_patterns_and_paths_give_files_in_sorted_order(tmp_path: Path) -> None:
    touch(tmp_path, "b_0.tif", "b_1.tif", "a_0.tif", "sub/a_9.tif", "b[1].tif")
    files, note = expand("--cam1", [str(tmp_path / "b_*.tif"), str(tmp_path / "a_0.tif"), str(tmp_path / "b_1.tif")])
    assert [f.name for f in files] == ["a_0.tif", "b_0.tif", "b_1.tif"]  # once each
    assert note is None
    files, _ = expand("--cam1", [str(tmp_path / "b[1].tif")])
    assert [f.name for f in files] == ["b[1].tif"]  # a file of that very name is no pattern


def test_an_order_that_is_not_the_numbers_is_pointed_out(tmp_path: Path) -> None:
    touch(tmp_path, "s1.tif", "s2.tif", "s10.tif")
    files, note = expand("--cam2", [str(tmp_path / "*.tif")])
    assert [f.name for f in files] == ["s1.tif", "s10.tif", "s2.tif"]
    assert note is not None
    assert "s10.tif comes before s2.tif" in note


@pytest.mark.parametrize("item", ["none.tif", "none_*.tif"])
def test_nothing_found_is_an_error(tmp_path: Path, item: str) -> None:
    with pytest.raises(ImageError) as caught:
        expand("--cam1", [str(tmp_path / item)])
    assert caught.value.code == "file_missing"
    assert item in caught.value.cause


def test_lists_that_do_not_pair_are_refused(tmp_path: Path) -> None:
    a, b, c = (tmp_path / n for n in "abc")
    with pytest.raises(InputError) as caught:
        pair_up([a, b], [c])
    assert caught.value.code == "counts_differ"
    assert "2 images" in caught.value.cause
    with pytest.raises(InputError) as caught:
        pair_up([a, b], [c, b])
    assert caught.value.code == "same_image"


def test_a_test_folder_gives_its_complete_steps(tmp_path: Path) -> None:
    for n in range(3):
        touch(tmp_path, f"steps/{n:04d}/cam1.tif", f"steps/{n:04d}/cam2.tif")
    for n in (0, 2):
        text = json.dumps({"sha256": {"cam1": "aa", "cam2": "bb"}})
        (tmp_path / f"steps/{n:04d}/step.json").write_text(text)
    pairs = pairs_of_test_folder(tmp_path)
    assert [p.cam1.parent.name for p in pairs] == ["0000", "0002"]
    assert (pairs[0].sha256_1, pairs[0].sha256_2) == ("aa", "bb")
    (tmp_path / "steps/0002/step.json").write_text("{")
    with pytest.raises(FileFormatError):
        pairs_of_test_folder(tmp_path)
    with pytest.raises(InputError) as caught:
        pairs_of_test_folder(tmp_path / "steps")
    assert caught.value.code == "no_steps"
    with pytest.raises(InputError) as caught:
        pairs_of_test_folder(tmp_path / "other")
    assert caught.value.code == "file_missing"


@pytest.mark.parametrize(
    "text",
    ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "nan,0,100,100", "0,0,inf,100", "300,100,100,200", "10,10,10,90", "1 2 3 4"],
)
def test_rois_that_say_nothing(text: str) -> None:
    with pytest.raises(RegionError) as caught:
        parse_rectangle(text)
    assert caught.value.code == "region_unusable"


@pytest.mark.parametrize(
    "text", ["circle:1,2", "circle:10,10,0", "circle:a,b,c", "polygon:1,2,3,4", "square:1,2,3", "5,5,1,1"]
)
def test_outlines_that_say_nothing(text: str) -> None:
    with pytest.raises(RegionError) as caught:
        parse_outline("--roi", text)
    assert caught.value.code in ("region_unusable", "cut_invalid")
    assert "--roi" in str(caught.value)


def test_outlines_of_all_forms_are_read_and_a_round_hole_lies_on_its_circle() -> None:
    assert parse_outline("--roi", "circle:100,90,40.5").circle == (100.0, 90.0, 40.5)
    assert parse_outline("--roi", "polygon:0,0,9,0,9,9").polygon == [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]
    assert parse_outline("--roi", "1,2,30,40").rectangle == (1.0, 2.0, 30.0, 40.0)
    assert parse_hole("1,2,30,40,5,60") == [[1.0, 2.0], [30.0, 40.0], [5.0, 60.0]]
    corners = np.array(parse_hole("circle:100,90,40"))
    assert np.allclose(np.hypot(*(corners - (100.0, 90.0)).T), 40.0)
    chord = np.hypot(*((corners + np.roll(corners, 1, axis=0)) / 2 - (100.0, 90.0)).T)
    assert np.all(chord > 39.95)  # a twentieth px: far below what a match tells


@pytest.mark.fault(40)
@pytest.mark.parametrize(
    ("rectangle", "word"),
    [
        ((600.0, 10.0, 900.0, 300.0), "512 x 480"),
        ((-5.0, 10.0, 300.0, 300.0), "512 x 480"),
        ((10.0, 10.0, 300.0, 481.0), "512 x 480"),
        ((100.0, 100.0, 101.0, 400.0), "smaller than one subset"),
        ((100.0, 100.0, 130.0, 400.0), "smaller than one subset"),
    ],
)
def test_regions_that_leave_nothing(rectangle: tuple[float, float, float, float], word: str) -> None:
    with pytest.raises(RegionError, match=word):
        check_region(
            [Outline.model_construct(rectangle=rectangle)],
            image_shape=SHAPE,
            subset_px=33,
            spacing_px=10,
            mask_path=None,
            seeds=[],
        )


def test_a_mask_must_fit_and_leave_points(tmp_path: Path) -> None:
    def check(mask: np.ndarray) -> None:
        Image.fromarray(mask).save(tmp_path / "mask.png")
        check_region(
            [Outline(rectangle=(100.0, 100.0, 300.0, 300.0))],
            image_shape=SHAPE,
            subset_px=33,
            spacing_px=10,
            mask_path=tmp_path / "mask.png",
            seeds=[],
        )

    with pytest.raises(RegionError) as caught:
        check(np.full((480, 511), 255, np.uint8))
    assert caught.value.code == "mask_size"
    for black in (
        np.zeros(SHAPE, np.uint8),
        np.pad(np.zeros((301, 301), np.uint8), ((0, 179), (0, 211)), constant_values=255),
    ):
        black[101:109, 101:109] = 255  # white, but between the points
        with pytest.raises(RegionError) as caught:
            check(black)
        assert caught.value.code == "region_empty"
    one_point = np.zeros(SHAPE, np.uint8)
    one_point[110, 120] = 255
    check(one_point)


@pytest.mark.parametrize(
    ("seed", "code"),
    [
        ("99,200", "seed_outside"),
        ("200,301", "seed_outside"),
        ("5000,5", "seed_outside"),
        ("nan,200", "region_unusable"),
        ("200", "region_unusable"),
        ("200,250", "seed_outside"),
    ],
)
def test_seeds_must_lie_in_the_region_and_on_white(tmp_path: Path, seed: str, code: str) -> None:
    mask = np.full(SHAPE, 255, np.uint8)
    mask[240:260] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    with pytest.raises(RegionError) as caught:
        check_region(
            [Outline(rectangle=(100.0, 100.0, 300.0, 300.0))],
            image_shape=SHAPE,
            subset_px=33,
            spacing_px=10,
            mask_path=tmp_path / "mask.png",
            seeds=["150,150", seed],
        )
    assert caught.value.code == code


def test_seeds_come_as_points() -> None:
    _, seeds = check_region(
        [Outline(rectangle=(100.0, 100.0, 300.0, 300.0))],
        image_shape=SHAPE,
        subset_px=33,
        spacing_px=10,
        mask_path=None,
        seeds=["150,160.5", "200,210"],
    )
    assert seeds == (Seed((150.0, 160.5)), Seed((200.0, 210.0)))


def test_a_seed_may_say_where_camera_2_sees_it() -> None:
    _, seeds = check_region(
        [Outline(rectangle=(100.0, 100.0, 300.0, 250.0))],
        image_shape=SHAPE,
        subset_px=33,
        spacing_px=10,
        mask_path=None,
        seeds=["150,160.5,151.25,158", "200,210"],
    )
    assert seeds == (Seed((150.0, 160.5), (151.25, 158.0)), Seed((200.0, 210.0)))
    with pytest.raises(RegionError, match="has 3 numbers") as refused:
        check_region(
            [Outline(rectangle=(100.0, 100.0, 300.0, 250.0))],
            image_shape=SHAPE,
            subset_px=33,
            spacing_px=10,
            mask_path=None,
            seeds=["150,160,151"],
        )
    assert "X2,Y2" in refused.value.remedy


@pytest.mark.parametrize("text", ["32", "0", "-33", "5", "999", "33.0", "many", ""])
def test_subsets_are_odd_and_sensible(text: str) -> None:
    with pytest.raises(InputError) as caught:
        check_whole("--subset", text, SUBSET_PX)
    assert caught.value.code == "option_out_of_range"
    assert check_whole("--subset", "33", SUBSET_PX) == 33
    assert check_whole("--step", "10", SPACING_PX) == 10


@pytest.mark.parametrize("arguments", [[], ["frobnicate"], ["--version"]])
def test_wrong_usage_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    out = capsys.readouterr()
    if arguments == ["--version"]:
        assert caught.value.code == 0
        assert out.out.startswith("stereorig ")
    else:
        assert caught.value.code == 2
        assert out.err.startswith("stereorig: wrong_usage: ")
        assert "Remedy: " in out.err
        assert out.err.count("\n") == 1


def test_the_command_line_runs_as_a_module() -> None:
    asked = [sys.executable, "-m", "stereorig", "frobnicate"]
    ended = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=120)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("stereorig: wrong_usage: ")


def test_durations_read_as_people_say_them() -> None:
    texts = [duration(s) for s in (0.4, 59.4, 61.0, 3600.0, 7500.0)]
    assert texts == ["0.4 s", "59 s", "1 min 01 s", "1 h 00 min", "2 h 05 min"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_estimates_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr("stereorig.server.cli.terminal.time.monotonic", lambda: clock[0])
    stream = Terminal()
    line = ProgressLine(stream)
    clock[0] += 30.0  # loading, which has nothing to do with the pace
    line.show("step 0 of 1", 0.0)
    clock[0] += 10.0
    line.show("step 0 of 1", 0.25)
    assert "25 % of all, about 30 s left" in stream.getvalue()
    line.close()
    assert stream.getvalue().endswith("\r")


def test_progress_without_a_terminal_prints_few_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("stereorig.server.cli.terminal.time.monotonic", lambda: clock[0])
    stream = io.StringIO()
    line = ProgressLine(stream)
    for k in range(601):
        clock[0] = 0.1 * k
        line.show("step", k / 600)
    assert 2 <= len(stream.getvalue().splitlines()) <= 5
    assert "\r" not in stream.getvalue()
