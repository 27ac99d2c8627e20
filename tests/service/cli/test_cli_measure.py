"""``stereorig measure`` end to end on rendered images with a known truth, and every bad input in one line."""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import xarray as xr
from PIL import Image

from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.measure import MeasureOptions
from stereorig.core.names import CAMERAS
from stereorig.core.settings import SUBSET_PX
from stereorig.server.cli import main
from stereorig.server.cli.measurement import measure
from stereorig.server.formats import images
from stereorig.server.formats.images import read_image, write_image
from stereorig.server.formats.results.reading import read_field, read_measured
from stereorig.server.report.source import find_source
from stereorig.server.report.steps import read_steps
from stereorig.server.results.warnings.analysis import analysis_warnings
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import truth_at
from tests.support import written_tiffs
from tests.support.measure_command import SIZE, command
from tests.support.measure_command import rig as rig

LOADS = (0.0, 0.5, 1.0)


@pytest.fixture(scope="module")
def originals(rig: SimRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three pairs of a moving block and the true calibration."""
    folder = tmp_path_factory.mktemp("block")
    rng = np.random.default_rng(1)
    for n, load in enumerate(LOADS):
        scene = make_scene(rig, "block", load=load)
        for name in CAMERAS:
            sim = rig.camera(name)
            seen = render(scene, sim.camera, sim.size_px, options=RenderOptions(blur_px=rig.blur_px, threads=1))
            write_image(folder / f"{name}_{n}.tif", sim.sensor.expose(sim.lighting.apply(seen), rng, exposure=1.0))
    calibration = {name: rig.camera(name).camera.paper_parameters() for name in CAMERAS}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    return folder


@pytest.fixture
def folder(originals: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    shutil.copytree(originals, tmp_path / "in")
    return tmp_path / "in"


@pytest.fixture(scope="module")
def measured(originals: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results") / "new" / "folder"
    assert main(command(originals, out)) == 0
    return out


def test_shape_and_displacement_agree_with_the_truth(measured: Path, rig: SimRig) -> None:
    assert sorted(p.name for p in measured.iterdir()) == [*(f"step_000{n}.nc" for n in range(3)), "summary.json"]
    for n, load in enumerate(LOADS):
        with xr.open_dataset(measured / f"step_000{n}.nc") as data:
            np.testing.assert_array_equal(data["x_px"][0], np.arange(50, 181, 10))
            np.testing.assert_array_equal(data["y_px"][:, 0], np.arange(45, 156, 10))
            xy = np.stack([data["x_px"], data["y_px"]], axis=-1)
            truth = truth_at(make_scene(rig, "block"), rig.cam1.camera, xy, now=make_scene(rig, "block", load=load))
            ok = data["status"].values == 0
            assert ok.mean() > 0.99
            # noise of 2 of 255 at 21 px gives 0.2 to 0.3 um; the true calibration adds nothing
            xyz = np.stack([data["x_mm"], data["y_mm"], data["z_mm"]], axis=-1)
            assert np.sqrt(np.mean((xyz - truth.xyz_mm)[ok] ** 2)) < 0.4e-3
            if n == 0:
                assert "u_mm" not in data
                assert data.attrs["kind"] == "shape"
                continue
            uvw = np.stack([data["u_mm"], data["v_mm"], data["w_mm"]], axis=-1)
            assert np.sqrt(np.mean((uvw - truth.uvw_mm)[ok] ** 2)) < 0.5e-3
            assert np.abs(uvw - truth.uvw_mm)[ok].max() < 3e-3
            assert data.attrs["kind"] == "displacement"
            assert json.loads(data.attrs["settings"])["subset_px"] == 21


def test_the_summary_tells_what_was_done(measured: Path, originals: Path) -> None:
    summary = json.loads((measured / "summary.json").read_text())
    assert [step["step"] for step in summary["steps"]] == [0, 1, 2]
    assert summary["settings"]["region"]["rectangle"] == [50.0, 45.0, 180.0, 155.0]
    assert summary["calibration"]["source"] == "calibration_json"
    for step in summary["steps"]:
        assert step["points"] == 14 * 12
        assert step["valid"] == sum(v for k, v in step["status"].items() if k in ("ok", "extrapolated"))
        assert step["epipolar_offset_rms_px"] < 0.05
        assert min(step["zncc_median"].values()) > 0.95
        assert Path(step["cam1"]).name == f"cam1_{step['step']}.tif"
    assert summary["steps"][0]["plane_residual_rms_mm"] < 0.5e-3  # the block's face is flat


@pytest.mark.parametrize("form", ["packed", "left", "right"])
def test_twelve_bits_clipped_at_4095_are_saturated_wherever_they_lie(
    folder: Path, tmp_path: Path, capfd: Any, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    monkeypatch.setattr(written_tiffs, "LAYOUTS", {"one strip": SIZE[::-1]})
    monkeypatch.setattr(written_tiffs, "WIDTH", SIZE[0])
    monkeypatch.setattr(written_tiffs, "HEIGHT", SIZE[1])
    clipped = {}
    for name, gain in (("cam1_0", 24), ("cam2_0", 8), ("cam1_1", 24), ("cam2_1", 24)):
        file = folder / f"{name}.tif"
        grey = np.minimum(read_image(file).astype(np.uint16) * gain + 1, 4095).astype(np.uint16)
        clipped[name] = float(np.mean(grey == 4095))
        if form == "packed":
            part = {"planar": False, "big": False, "differences": False}
            file.write_bytes(written_tiffs.tiff(grey[..., None], 12, "one strip", "none", "<", **part))
        else:
            write_image(file, np.asarray(grey * 16 if form == "left" else grey, np.uint16))
    pairs = {cam: [str(folder / f"{cam}_{n}.tif") for n in (0, 1)] for cam in CAMERAS}
    assert main(command(folder, tmp_path / "out", **pairs)) == 0
    assert clipped["cam1_0"] > 0.03
    steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    for step in steps:
        assert step["quality"]["code"] == "saturated"
        for cam in CAMERAS:
            assert step["quality"][cam]["saturated_share"] == pytest.approx(clipped[f"{cam}_{step['n']}"], abs=1e-5)
    said = capfd.readouterr().err
    assert f"warning: step 0: cam1: {clipped['cam1_0']:.1%} of its pixels are at full scale" in said
    assert (said.count("step 0: cam2: "), said.count("step 1: cam1: "), said.count("step 1: cam2: ")) == (0, 0, 1)
    assert [one.code for one in analysis_warnings(tmp_path / "out")] == ["image_quality"]


@pytest.mark.fault(66)
def test_interlaced_images_are_warned_of_in_the_summary_and_in_a_report_made_later(
    folder: Path, tmp_path: Path
) -> None:
    for name in CAMERAS:
        file = folder / f"{name}_1.tif"
        image = read_image(file).copy()
        image[1::2] = np.roll(image[1::2], 1, axis=1)
        write_image(file, image)
    pairs = {cam: [str(folder / f"{cam}_{n}.tif") for n in (0, 1)] for cam in CAMERAS}
    assert main(command(folder, tmp_path / "out", subset="25", **pairs)) == 0
    measured = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    reported = [one.summary.epipolar_check for one in read_steps(find_source(tmp_path / "out")).steps]
    for n, (kept, later) in enumerate(zip(measured, reported, strict=True)):
        assert later is not None
        assert ("interlaced images" in later.reason) == (n == 1)
        assert (later.level, later.reason) == (kept["epipolar_check"]["level"], kept["epipolar_check"]["reason"])


def test_a_crack_and_a_hole_from_the_command_line(folder: Path, tmp_path: Path) -> None:
    arguments = command(folder, tmp_path / "out", cam1=str(folder / "cam1_0.tif"), cam2=str(folder / "cam2_0.tif"))
    crack, hole = "50,100.2,90.5,101.7,130,96.4", "140,60,165,60,165,85,140,85"
    assert main([*arguments, "--crack", crack, "--hole", hole]) == 0
    with xr.open_dataset(tmp_path / "out" / "step_0000.nc") as data:
        settings = json.loads(data.attrs["settings"])
        assert settings["region"]["cracks"] == [[[50.0, 100.2], [90.5, 101.7], [130.0, 96.4]]]
        assert settings["region"]["holes"] == [[[140.0, 60.0], [165.0, 60.0], [165.0, 85.0], [140.0, 85.0]]]
        inside = (data["x_px"] >= 140) & (data["x_px"] <= 165) & (data["y_px"] >= 60) & (data["y_px"] <= 85)
        assert (data["status"].values[inside.values] == 2).all()
        assert (data["status"].values[~inside.values] == 0).mean() > 0.97
        assert data["cut_line"].values.tolist() == [0] * 5 + [1] * 3  # the hole's border is closed
        assert data["cut_y_px"].values[5:].tolist() == [100.2, 101.7, 96.4]
    cuts = read_field(tmp_path / "out" / "step_0000.nc").cuts
    assert cuts is not None
    assert cuts.lines_px[1].tolist() == settings["region"]["cracks"][0]


@pytest.mark.parametrize(
    ("option", "text", "code"),
    [
        ("--crack", "50,100", "cut_invalid"),
        ("--crack", "50,100,60", "cut_invalid"),
        ("--crack", "a,b,c,d", "cut_invalid"),
        ("--crack", "50,100,nan,100", "cut_invalid"),
        ("--crack", "60,100,60,100", "cut_invalid"),
        ("--crack", "50,100,500,100", "cut_outside_image"),
        ("--hole", "50,60,70,60", "cut_invalid"),
        ("--hole", "50,60,70,80,60,70", "region_empty"),
        ("--hole", "10,10,200,10,200,180,10,180", "region_empty"),
    ],
)
def test_cracks_and_holes_that_are_none(
    originals: Path, tmp_path: Path, capfd: Any, option: str, text: str, code: str
) -> None:
    assert main([*command(originals, tmp_path / "out"), option, text]) != 0
    assert code in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_several_paths_a_mask_seeds_and_the_other_models(folder: Path, tmp_path: Path, capfd: Any) -> None:
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[40:160, 45:121] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    out = tmp_path / "out"
    (tmp_path / "out").mkdir()
    (out / "step_0007.nc").write_text("of an earlier, longer run")
    (out / "notes.txt").write_text("the user's own")
    code = main(
        command(
            folder,
            out,
            cam1=[str(folder / "cam1_0.tif"), str(folder / "cam1_1.tif")],
            cam2=[str(folder / "cam2_1.tif"), str(folder / "cam2_0.tif")],
            mask=str(folder / "mask.png"),
            patch="rigid",
            interpolation="cubic",
            seed="80,85",
        )
    )
    assert code == 0
    assert sorted(p.name for p in out.iterdir()) == ["notes.txt", "step_0000.nc", "step_0001.nc", "summary.json"]
    with xr.open_dataset(out / "step_0001.nc") as data:
        masked = data["status"].values == 2
        np.testing.assert_array_equal(masked, np.broadcast_to(np.arange(50, 181, 10) > 120, masked.shape))
        assert np.isnan(data["w_mm"].values[masked]).all()
        assert (data["status"].values[~masked] == 0).mean() > 0.99
        assert json.loads(data.attrs["settings"])["patch"] == "rigid"
        assert "mask" in json.loads(data.attrs["inputs_sha256"])
    err = capfd.readouterr().err
    assert "step 1 of 1" in err
    assert "u (k = 1) of step 1, medians: Z" in err
    assert "calibration not included" in err  # parameters alone have no covariance
    summary = json.loads((out / "summary.json").read_text())["steps"][1]
    assert list(summary["budget_median_mm"]["w_mm"]) == ["matching", "reference"]
    assert "calibration not included" in summary["uncertainty_includes"]


def test_a_test_folder_copied_by_hand(folder: Path, tmp_path: Path, measured: Path) -> None:
    test = tmp_path / "t000001"
    hashes = json.loads((measured / "summary.json").read_text())["steps"]
    for n in range(2):
        step = test / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        for cam in CAMERAS:
            shutil.copy(folder / f"{cam}_{n}.tif", step / f"{cam}.tif")
        (step / "step.json").write_text(json.dumps({"n": n, "sha256": hashes[n]["sha256"]}))
    shutil.copy(folder / "calibration.json", test)
    assert main(["measure", str(test), "--subset", "21", "--step", "20"]) == 0
    summary = json.loads((test / "exports" / "measure" / "summary.json").read_text())
    for step in summary["steps"]:  # camera 2 does not see the rim of camera 1's image
        assert step["valid"] > 70
        assert set(step["status"]) <= {"ok", "outside_image"}


@pytest.mark.fault(4)
def test_a_flipped_bit_in_a_test_folder_is_named(folder: Path, tmp_path: Path, capfd: Any) -> None:
    step = tmp_path / "t" / "steps" / "0000"
    step.mkdir(parents=True)
    for cam in CAMERAS:
        shutil.copy(folder / f"{cam}_0.tif", step / f"{cam}.tif")
    (step / "step.json").write_text(json.dumps({"sha256": {"cam1": "0" * 64}}))
    shutil.copy(folder / "calibration.json", tmp_path / "t")
    fails(["measure", str(tmp_path / "t")], "checksum_mismatch", "cam1.tif", capfd)


def test_defaults_are_the_measurements_own() -> None:
    parser = argparse.ArgumentParser()
    measure.add_arguments(parser)
    given = parser.parse_args([])
    # left open, so that a recipe may say them; the measurement has them else, and the help tells them
    assert (given.subset, given.patch, given.interpolation) == (None, None, None)
    assert SUBSET_PX.default == MeasureOptions().subset_px
    assert f"odd ({MeasureOptions().subset_px})" in parser.format_help()


def test_strain_is_in_files_and_summary(measured: Path) -> None:
    """A block moves as a whole: its strain is noise, of the reported size."""
    summary = json.loads((measured / "summary.json").read_text())
    assert summary["settings"]["strain"] == {"window": 9, "order": "auto", "tensor": "green_lagrange"}
    assert summary["steps"][0]["strain"] is None
    for step in summary["steps"][1:]:
        strain = step["strain"]
        assert strain["gauge_px"] == 8 * 10 + 21
        assert strain["gauge_mm"] == pytest.approx(101 * 0.033, rel=0.1)
        with xr.open_dataset(measured / step["file"]) as data:
            whole = (slice(4, -4), slice(4, -4))
            assert (data["strain_status"].values[whole] == 0).all()
            for name in ("exx", "eyy", "exy"):
                off, sigma = (1e6 * data[n].values[whole] for n in (name, f"sigma_{name}"))
                assert np.abs(off).max() < 5 * sigma.max()
                assert np.median(data[f"sigma_{name}"].values[data["strain_status"].values == 0]) * 1e6 == (
                    pytest.approx(strain["noise_floor_microstrain"][name], rel=1e-4)
                )
                assert sigma.max() < 150.0
            assert np.isnan(data["exx"].values[data["strain_status"].values != 0]).all()
    with xr.open_dataset(measured / "step_0000.nc") as data:
        assert "exx" not in data


def test_strain_off_and_other_strain(folder: Path, tmp_path: Path) -> None:
    two = {name: [str(folder / f"{name}_{n}.tif") for n in (0, 2)] for name in ("cam1", "cam2")}
    assert main(command(folder, tmp_path / "off", roi="60,60,120,120", strain="off", **two)) == 0
    summary = json.loads((tmp_path / "off" / "summary.json").read_text())
    assert summary["settings"]["strain"] is None
    assert summary["steps"][1]["strain"] is None
    with xr.open_dataset(tmp_path / "off" / "step_0001.nc") as data:
        assert "exx" not in data
    more = {"strain": "5", "strain-order": "2", "strain-tensor": "hencky"}
    assert main(command(folder, tmp_path / "on", roi="60,60,120,120", **more, **two)) == 0
    with xr.open_dataset(tmp_path / "on" / "step_0001.nc") as data:
        assert "Hencky" in data["exx"].long_name
        assert data["exx"].window_points == 5
        assert json.loads(data.attrs["strain"])["order"] == 2


def fails(arguments: list[str], code: str, word: str, capfd: Any) -> None:
    assert main(arguments) == 1
    err = capfd.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("stereorig: ")]
    assert len(lines) == 1, err
    assert lines[0].startswith(f"stereorig: {code}: ")
    assert word in lines[0]
    assert " Remedy: " in lines[0]
    assert "Traceback" not in err


BAD_OPTIONS: list[tuple[dict[str, Any], str, str]] = [
    ({"strain": "4"}, "option_out_of_range", "--strain"),
    ({"strain": "wide"}, "option_out_of_range", "--strain"),
    ({"strain": "103"}, "option_out_of_range", "--strain"),
    ({"cam1": "IN/none_*.tif"}, "file_missing", "none_"),
    ({"cam2": ["IN/cam2_0.tif", "IN/none.tif"]}, "file_missing", "none.tif"),
    ({"cam2": ["IN/cam2_0.tif"]}, "counts_differ", "3 images"),
    ({"cam2": "IN/cam1_*.tif"}, "same_image", "cam1_0.tif"),
    ({"calibration": "IN/none.json"}, "file_missing", "none.json"),
    ({"calibration": "IN/cam1_0.tif"}, "calibration_unreadable", "cam1_0.tif"),
    ({"roi": "300,20,400,100"}, "region_outside_image", "230 x 200"),
    ({"roi": "-20,20,100,100"}, "region_outside_image", "230 x 200"),
    ({"roi": "180,155,50,45"}, "region_unusable", "empty"),
    ({"roi": "50,50,50,50"}, "region_unusable", "empty"),
    ({"roi": "nan,45,180,155"}, "region_unusable", "finite"),
    ({"roi": "50,45,60,155"}, "region_too_small", "smaller"),
    ({"mask": "IN/none.png"}, "file_missing", "none.png"),
    ({"mask": "IN/wrong.png"}, "mask_size", "100 x 100"),
    ({"mask": "IN/black.png"}, "region_empty", "white"),
    ({"subset": "20"}, "option_out_of_range", "20"),
    ({"subset": "zwanzig"}, "option_out_of_range", "zwanzig"),
    ({"step": "0"}, "option_out_of_range", "--step"),
    ({"seed": "10,10"}, "seed_outside", "10,10"),
    ({"seed": "1000,90"}, "seed_outside", "1000,90"),
    ({"seed": "80,85,500,85"}, "seed_outside", "camera 2"),
    ({"seed": "80,85,80,150"}, "seed_off_epipolar", "epipolar line"),
    ({"roi": None, "subset": "101"}, "region_not_found", "101 px"),
    ({"calibration": None}, "option_missing", "--calibration"),
    ({"out": "IN/cam1_0.tif"}, "output_unusable", "cam1_0.tif"),
]


@pytest.mark.parametrize(("changes", "code", "word"), BAD_OPTIONS, ids=lambda v: str(v)[:40])
def test_bad_options(folder: Path, tmp_path: Path, capfd: Any, changes: dict[str, Any], code: str, word: str) -> None:
    Image.fromarray(np.full((100, 100), 255, np.uint8)).save(folder / "wrong.png")
    Image.fromarray(np.zeros((SIZE[1], SIZE[0]), np.uint8)).save(folder / "black.png")
    options = {
        k: [s.replace("IN", str(folder), 1) for s in v]
        if isinstance(v, list)
        else v
        if v is None
        else v.replace("IN", str(folder), 1)
        for k, v in changes.items()
    }
    before = sorted(folder.iterdir())
    fails(command(folder, tmp_path / "out", **options), code, word, capfd)
    assert not (tmp_path / "out").exists()
    assert sorted(folder.iterdir()) == before


def spoiled(folder: Path) -> list[tuple[np.ndarray | bytes, str, str]]:
    """What a second camera may deliver, and what is said of it."""
    good = read_image(folder / "cam2_1.tif")
    return [
        (good[:, :-1], "image_size_mismatch", "229 x 200"),
        (np.full_like(good, 90), "image_blank", "90"),
        (good[:50], "image_size_mismatch", "step 1"),
        ((folder / "cam2_0.tif").read_bytes()[:2000], "image_unreadable", "cam2_1.tif"),
        ((folder / "cam1_1.tif").read_bytes(), "same_image", "cam1_1.tif"),
    ]


def put(path: Path, what: np.ndarray | bytes) -> None:
    if isinstance(what, bytes):
        path.write_bytes(what)
    else:
        write_image(path, what)


def test_a_bad_reference_pair_is_refused_as_a_whole(folder: Path, tmp_path: Path, capfd: Any) -> None:
    good = read_image(folder / "cam2_0.tif")
    for data, code, word in (
        (np.full_like(good, 90), "image_blank", "90"),
        ((folder / "cam2_0.tif").read_bytes()[:2000], "image_unreadable", "cam2_0.tif"),
    ):
        put(folder / "cam2_0.tif", data)
        fails(command(folder, tmp_path / "out"), code, word, capfd)
    assert not (tmp_path / "out").exists()


def test_a_bad_pair_is_a_failed_step_and_the_rest_is_measured(folder: Path, tmp_path: Path, capfd: Any) -> None:
    options = {"roi": "60,60,120,120", "strain": "off"}
    assert (
        main(
            command(
                folder,
                tmp_path / "alone",
                cam1=[str(folder / f"cam1_{n}.tif") for n in (0, 2)],
                cam2=[str(folder / f"cam2_{n}.tif") for n in (0, 2)],
                **options,
            )
        )
        == 0
    )
    for data, code, word in spoiled(folder):
        put(folder / "cam2_1.tif", data)
        capfd.readouterr()
        assert main(command(folder, tmp_path / "out", **options)) == measure.SOME_FAILED
        err = capfd.readouterr().err
        assert f"step 1 of 2: failed: {code}: " in err
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["state"] == "succeeded"
        assert [step["n"] for step in summary["steps"]] == [0, 2]
        problem = summary["steps_failed"]["1"]
        assert problem["code"] == code
        assert word in problem["detail"]
        assert problem["remedy"]
        assert problem["context"]["cam2"] == str(folder / "cam2_1.tif")
        assert not (tmp_path / "out" / "step_0001.nc").exists()
    # exports and reports say which step there is not, and why
    assert (
        main(["export", str(tmp_path / "out"), "--format", "csv", "--step", "2", "--out", str(tmp_path / "csv")]) == 0
    )
    assert '"same_image"' in next((tmp_path / "csv").glob("*.csv")).read_text()
    assert main(["report", str(tmp_path / "out"), "--out", str(tmp_path / "report.html")]) == 0
    assert f"Step 1 could not be measured: same_image: {problem['detail']}" in (tmp_path / "report.html").read_text()
    # the step after the bad one is what it would have been without it
    with (
        xr.open_dataset(tmp_path / "alone" / "step_0001.nc") as alone,
        xr.open_dataset(tmp_path / "out" / "step_0002.nc") as among,
    ):
        np.testing.assert_array_equal(alone.w_mm, among.w_mm)


def test_an_image_of_a_later_step_is_decoded_once(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: Counter[str] = Counter()

    def counted(data: bytes, name: str) -> Any:
        seen[Path(name).name] += 1
        return samples(data, name)

    samples = images._samples
    monkeypatch.setattr(images, "_samples", counted)
    assert main(command(folder, tmp_path / "out", roi="60,60,120,120", strain="off")) == 0
    assert {name: seen[name] for name in seen if "_0" not in name} == {
        f"{cam}_{n}.tif": 1 for cam in CAMERAS for n in (1, 2)
    }


@pytest.mark.parametrize("update", ["always", "auto"])
def test_a_pair_of_another_specimen_is_a_failed_step_with_later_references_too(
    folder: Path, tmp_path: Path, capfd: Any, update: str
) -> None:
    rng = np.random.default_rng(5)
    for cam in CAMERAS:  # a texture in each, but none that is in another image
        noise = cv2.GaussianBlur(rng.normal(size=(SIZE[1], SIZE[0])), (0, 0), 1.5)
        write_image(folder / f"{cam}_3.tif", np.clip(120 + 40 * noise / noise.std(), 0, 255).astype(np.uint8))
        write_image(folder / f"{cam}_4.tif", read_image(folder / f"{cam}_1.tif"))
    more = {"roi": "60,60,120,120", "strain": "off", "reference-update": update}
    assert main(command(folder, tmp_path / "out", **more)) == measure.SOME_FAILED
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert list(summary["steps_failed"]) == ["3"]
    assert summary["steps_failed"]["3"]["code"] == "not_seeded"
    assert [step["n"] for step in summary["steps"]] == [0, 1, 2, 4]
    if update == "always":
        assert summary["steps"][-1]["reference_step"] == 2  # the last good one
    assert summary["steps"][-1]["valid"] > 0.9 * summary["steps"][-1]["points"]


def test_a_series_of_which_nothing_but_the_reference_could_be_measured_has_failed(
    folder: Path, tmp_path: Path, capfd: Any
) -> None:
    good = read_image(folder / "cam2_1.tif")
    for n in (1, 2):
        write_image(folder / f"cam2_{n}.tif", np.full_like(good, 90))
    fails(command(folder, tmp_path / "out", roi="60,60,120,120", strain="off"), "image_blank", "step 1", capfd)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["state"] == "failed"
    assert summary["problem"]["code"] == "image_blank"
    assert [step["n"] for step in summary["steps"]] == [0]
    assert list(summary["steps_failed"]) == ["1", "2"]


def test_under_a_projected_pattern_the_first_pair_fails_alone_too(folder: Path, tmp_path: Path) -> None:
    (folder / "cam1_0.tif").write_bytes(b"nothing")
    options = command(folder, tmp_path / "out", roi="60,60,120,120")
    assert main([*options, "--projected"]) == measure.SOME_FAILED
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert list(summary["steps_failed"]) == ["0"]
    assert [step["n"] for step in summary["steps"]] == [1, 2]


def test_bad_calibrations(folder: Path, tmp_path: Path, capfd: Any) -> None:
    content = json.loads((folder / "calibration.json").read_text())
    path = folder / "calibration.json"
    for changes, code in (
        ({"phd_px": float("nan")}, "calibration_invalid"),
        ({"aspect": None}, "calibration_unreadable"),
    ):
        path.write_text(json.dumps({**content, "cam2": {**content["cam2"], **changes}}))
        fails(command(folder, tmp_path / "out"), code, next(iter(changes)), capfd)
    path.write_text(json.dumps({**content, "image_size_px": {"cam1": [512, 480], "cam2": [512, 480]}}))
    fails(command(folder, tmp_path / "out"), "image_size_mismatch", "512 x 480", capfd)
    path.write_text(json.dumps({"cam1": content["cam1"], "cam2": content["cam1"]}))
    fails(command(folder, tmp_path / "out"), "calibration_invalid", "same position", capfd)
    assert not (tmp_path / "out").exists()


def test_swapped_cameras_are_refused(folder: Path, tmp_path: Path, capfd: Any) -> None:
    swapped = command(folder, tmp_path / "out", cam1=str(folder / "cam2_*.tif"), cam2=str(folder / "cam1_*.tif"))
    fails(swapped, "cameras_swapped", "", capfd)
    assert not (tmp_path / "out").exists()


def test_noise_without_texture_is_refused(folder: Path, tmp_path: Path, capfd: Any) -> None:
    rng = np.random.default_rng(2)
    for cam in CAMERAS:
        write_image(folder / f"{cam}_0.tif", rng.normal(120, 2, (SIZE[1], SIZE[0])).round().astype(np.uint8))
    fails(command(folder, tmp_path / "out"), "image_blank", "noise only", capfd)
    assert not (tmp_path / "out").exists()


def test_without_a_region_the_specimen_is_found_and_can_be_corrected(
    folder: Path, tmp_path: Path, capfd: Any, rig: SimRig
) -> None:
    for n in (1, 2):
        for cam in CAMERAS:
            (folder / f"{cam}_{n}.tif").unlink()
    for cam, x in (("cam1", 120), ("cam2", 110)):  # half of the view is plain: no specimen there
        image = read_image(folder / f"{cam}_0.tif").copy()
        image[:, x:] = np.random.default_rng(1).normal(70.0, 2.0, image[:, x:].shape).round()
        write_image(folder / f"{cam}_0.tif", image)
    out = tmp_path / "out"
    assert main(command(folder, out, roi=None)) == 0
    assert "region: texture that camera 2 sees: 1 part" in capfd.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    found = summary["region_found"]
    assert summary["settings"]["region"]["mask"] == str(out / "specimen.png")
    (outline,) = np.array(found["outlines_px"])
    assert 110 < outline[:, 0].max() < 125
    white = np.array(Image.open(out / "specimen.png")) > 127
    assert white[20:-20, 5:100].mean() > 0.95
    assert not white[:, 130:].any()
    with xr.open_dataset(out / "step_0000.nc") as data:
        measured = data.status.values == 0
        allowed = data.status.values != 2
        assert measured[allowed].mean() > 0.8
        assert float(data.x_px.values[measured].max()) < 125
    # corrected by hand, it is a mask like any other
    white[100:] = False
    Image.fromarray(white).save(tmp_path / "mine.png")
    assert main(command(folder, tmp_path / "corrected", roi=None, mask=str(tmp_path / "mine.png"))) == 0
    with xr.open_dataset(tmp_path / "corrected" / "step_0000.nc") as data:
        assert float(data.y_px.values[data.status.values == 0].max()) < 100
    assert main(command(folder, tmp_path / "auto", roi="auto", mask=str(tmp_path / "mine.png"))) == 0
    assert json.loads((tmp_path / "auto" / "summary.json").read_text())["region_found"] is not None


def test_colour_images_are_measured_by_their_luminance_and_said_so(folder: Path, tmp_path: Path) -> None:
    options = {"roi": "60,60,120,120", "strain": "off"}
    gray, colour = {}, {}
    for cam in CAMERAS:
        gray[cam], colour[cam] = [], []
        for n in (0, 1):
            image = read_image(folder / f"{cam}_{n}.tif").astype(float)
            rgb = np.clip(np.stack([image * 0.8, image * 0.9, image], axis=-1), 0, 255).round().astype(np.uint8)
            colour[cam].append(str(folder / f"colour_{cam}_{n}.png"))
            Image.fromarray(rgb).save(colour[cam][-1])
            gray[cam].append(str(folder / f"gray_{cam}_{n}.tif"))
            write_image(Path(gray[cam][-1]), np.rint(rgb @ np.array([0.299, 0.587, 0.114])).astype(np.uint8))
    assert main(command(folder, tmp_path / "colour", **colour, **options)) == 0
    assert main(command(folder, tmp_path / "gray", **gray, **options)) == 0
    taken, plain = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("colour", "gray"))
    said = "luminance, 0.299 R + 0.587 G + 0.114 B"
    assert taken["steps"][1]["grey_from"] == {"cam1": said, "cam2": said}
    assert "grey_from" not in plain["steps"][1]
    one, two = (xr.open_dataset(tmp_path / name / "step_0001.nc") for name in ("colour", "gray"))
    with one, two:
        np.testing.assert_array_equal(one.w_mm, two.w_mm)
        assert one.attrs["cam1_grey_from"] == said


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that takes no new folders")
def test_a_folder_that_cannot_be_made(folder: Path, capfd: Any) -> None:
    fails(command(folder, Path("/proc/stereorig/out")), "output_unusable", "/proc/stereorig", capfd)


@pytest.mark.specimen
def test_the_specimen(specimen_dir: Path, tmp_path: Path) -> None:
    code = main(
        [
            "measure",
            "--cam1",
            str(specimen_dir / "*_0.tif"),
            "--cam2",
            str(specimen_dir / "*_1.tif"),
            "--calibration",
            str(specimen_dir / "calibration_dice.xml"),
            "--roi",
            "340,430,1560,690",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    assert code == 0
    steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    assert len(steps) == 3
    for step in steps:
        assert step["points"] == 123 * 27
        assert step["valid_fraction"] >= 0.97
        # the calibration that came with the images is off by 0.09 px across the epipolar lines
        assert step["epipolar_offset_sd_px"] <= 0.08
        assert abs(step["epipolar_offset_mean_px"]) <= 0.1
        assert step["plane_residual_rms_mm"] <= 0.015
        # nothing wrong among the valid: no point far from the epipolar line
        with xr.open_dataset(tmp_path / "out" / step["file"]) as data:
            ok = np.isin(data["status"], (0, 10))
            off = data["epipolar_px"].values[ok] - np.median(data["epipolar_px"].values[ok])
            assert np.abs(off).max() <= 5 * 0.08


def test_a_noise_file_is_used_and_recorded(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereorig.core.noise import NoiseModel
    from stereorig.server.formats.noise_json import load_noise, noise_content, write_noise

    file = tmp_path / "noise.json"
    model = NoiseModel(coefficients=(1.96, 0.0128, 0.0), frames=8)
    write_noise(file, noise_content({"cam1": model, "cam2": model}))
    out = tmp_path / "out"
    assert (
        main(
            command(
                folder,
                out,
                noise=str(file),
                roi="90,80,130,110",
                cam1=[str(folder / "cam1_0.tif")],
                cam2=[str(folder / "cam2_0.tif")],
            )
        )
        == 0
    )
    with xr.open_dataset(out / "step_0000.nc") as data:
        assert (data["status"].values == 0).all()
        settings, inputs = (json.loads(data.attrs[name]) for name in ("settings", "inputs_sha256"))
    assert inputs["noise"] == load_noise(file).sha256
    assert settings["noise"]["cam1"] == {"coefficients": [1.96, 0.0128, 0.0], "frames": 8}
    assert "these cameras' gain" not in capsys.readouterr().err
    wrong = NoiseModel(coefficients=(12.0, 0.0, 0.0), frames=8)
    write_noise(file, noise_content({"cam1": wrong, "cam2": wrong}))
    assert (
        main(
            command(
                folder,
                out,
                noise=str(file),
                roi="90,80,130,110",
                cam1=[str(folder / "cam1_0.tif")],
                cam2=[str(folder / "cam2_0.tif")],
            )
        )
        == 0
    )
    assert "the noise file states 3.46" in capsys.readouterr().err


def test_a_prefilter_is_recorded_and_silly_ones_are_refused(
    originals: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            command(
                originals,
                tmp_path / "out",
                cam1=str(originals / "cam1_[01].tif"),
                cam2=str(originals / "cam2_[01].tif"),
                prefilter="0.8",
            )
        )
        == 0
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["settings"]["prefilter_px"] == 0.8
    with xr.open_dataset(tmp_path / "out" / "step_0001.nc") as data:
        assert json.loads(data.attrs["settings"])["prefilter_px"] == 0.8
    for wrong in ("-1", "nan", "5.3", "much"):
        capsys.readouterr()
        assert main(command(originals, tmp_path / "no", prefilter=wrong)) != 0
        assert "prefilter" in capsys.readouterr().err
        assert not (tmp_path / "no").exists()


def test_smoothing_is_told_and_the_measurement_stays_reproducible(
    originals: Path, measured: Path, tmp_path: Path, capfd: Any
) -> None:
    assert main(command(originals, tmp_path / "out", smooth="5")) == 0
    printed = capfd.readouterr()
    assert "smoothed over 5 points: their spatial resolution is 61 px" in printed.err + printed.out
    assert "gauge grows from 101 to 141 px" in printed.err + printed.out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["settings"]["smoothing_window"] == 5
    assert summary["steps"][0]["smoothing"] is None
    smoothed = summary["steps"][2]["smoothing"]
    assert (smoothed["window"], smoothed["resolution_px"]) == (5, 61.0)
    # 33 um a pixel, more along the surface where it is inclined
    assert 0.033 * 61 < smoothed["resolution_mm"] < 0.04 * 61
    raw, smooth = (read_field(folder / "step_0002.nc") for folder in (measured, tmp_path / "out"))
    assert smooth.smoothing is not None
    np.testing.assert_array_equal(smooth.status, raw.status)
    np.testing.assert_array_equal(smooth.xyz_mm, raw.xyz_mm)
    again = smoothed_displacement(raw, 5, subset_px=21)
    np.testing.assert_allclose(smooth.uvw_mm, again.uvw_mm, atol=1e-9)
    assert np.nanmean(smooth.sigma_mm[..., 5]) < 0.9 * np.nanmean(raw.sigma_mm[..., 5])
    with xr.open_dataset(tmp_path / "out" / "step_0002.nc") as data:
        assert data["exx"].attrs["gauge_px"] == 141.0
        assert "smoothed" in data["u_mm"].attrs["long_name"]
        assert "smoothing" in data.attrs["strain_note"]
    assert main(["gauge", str(tmp_path / "out"), "--area", "all"]) == 0
    for wrong in ("4", "1", "53", "some"):
        assert main(command(originals, tmp_path / "no", smooth=wrong)) != 0
        assert "--smooth" in capfd.readouterr().err


def test_each_step_against_the_one_before_it(folder: Path, tmp_path: Path, rig: SimRig) -> None:
    """Incremental correlation: displacements stay totals; each file states what it was matched against."""
    out = tmp_path / "out"
    assert main([*command(folder, out), "--reference-update", "always", "--smooth", "3"]) == 0
    steps = json.loads((out / "summary.json").read_text())["steps"]
    assert [step.get("reference_step") for step in steps] == [None, 0, 1]
    assert steps[2]["points_by_reference"] == {"1": steps[2]["valid"]}
    with xr.open_dataset(out / "step_0002.nc") as data:
        assert data.attrs["reference_step"] == 1
        assert json.loads(data.attrs["settings"])["reference_update"] == "always"
        inputs = json.loads(data.attrs["inputs_sha256"])
        assert inputs["matched_cam1"] == steps[1]["sha256"]["cam1"]
        xy = np.stack([data["x_px"], data["y_px"]], axis=-1)
        ok = data["status"].values == 0
        assert (data["reference_step"].values[ok] == 1).all()
        smooth, plain = (np.stack([data[f"{p}{c}_mm"] for c in "uvw"], axis=-1) for p in ("", "measured_"))
    truth = truth_at(make_scene(rig, "block"), rig.cam1.camera, xy, now=make_scene(rig, "block", load=LOADS[2]))
    assert ok.mean() > 0.99
    assert np.abs(plain - truth.uvw_mm)[ok].max() < 3e-3
    assert np.abs(smooth - plain)[ok].max() > 1e-5
    with xr.open_dataset(out / "step_0001.nc") as data:
        assert data.attrs["reference_step"] == 0
    again = read_measured(out / "step_0002.nc")
    np.testing.assert_array_equal(again.uvw_mm, plain)
    assert again.references is not None
    assert np.isfinite(again.references.noise_px2[ok]).all()


def test_a_way_of_updating_that_is_none_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*command(folder, tmp_path / "out"), "--reference-update", "sometimes"])
    assert caught.value.code == 2


def test_a_dense_field_lies_beside_each_step_and_is_read_as_any_other(
    originals: Path, rig: SimRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results"
    assert main(command(originals, out, dense="2")) == 0
    assert "step 1: dense field of" in capsys.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    for n, load in enumerate(LOADS):
        path = out / "dense" / f"step_000{n}.nc"
        entry = summary["steps"][n]["dense"]
        assert (entry["file"], entry["method"]) == (f"dense/{path.name}", "dense, shared windows")
        field, ordinary = read_field(path), read_measured(out / path.name)
        assert field.shape == (56, 66)
        assert entry["valid"] == field.valid.sum() > 0.95 * field.status.size
        assert field.dense is not None
        assert (field.dense.step_px, field.dense.window_px, field.dense.spacing_px) == (2, 21, 10.0)
        xy = np.stack([field.x_px, field.y_px], axis=-1)
        truth = truth_at(make_scene(rig, "block"), rig.cam1.camera, xy, now=make_scene(rig, "block", load=load))
        off = (field.xyz_mm - truth.xyz_mm)[field.valid] / field.sigma_mm[field.valid][:, :3]
        assert 0.5 < np.sqrt(np.mean(off**2)) < 1.5
        if n > 0:
            assert field.uvw_mm is not None
            off = (field.uvw_mm - truth.uvw_mm)[field.valid] / field.sigma_mm[field.valid][:, 3:]
            assert 0.5 < np.sqrt(np.mean(off**2)) < 1.5
        with xr.open_dataset(path) as data:
            assert data.attrs["method"] == "dense, shared windows"
            assert "correlate" in data.attrs["neighbours"]
            assert json.loads(data.attrs["settings"])["spacing_px"] == 2
        # the ordinary result is what it is without a dense one
        assert ordinary.dense is None
    assert main(["export", str(out / "dense"), "--format", "vtu", "--out", str(tmp_path / "vtu")]) == 0
    assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 3
    page = tmp_path / "report.html"
    assert main(["report", str(out), "--out", str(page)]) == 0
    words = re.sub(r"<[^>]+>|\s", " ", page.read_text(encoding="utf-8")).split()
    assert re.search(r"Dense field 2 px = [0-9.]+ mm, dense, shared windows", " ".join(words))
    # a later run without one leaves none behind that would pass for its own
    assert main(command(originals, out)) == 0
    assert list((out / "dense").iterdir()) == []


@pytest.mark.deep
def test_a_step_matched_against_a_later_reference_says_why_it_has_no_dense_field(
    originals: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results"
    assert main(command(originals, out, dense="4", **{"reference-update": "always"})) == 0
    assert "step 2: no dense field: the step was matched against a later reference." in capsys.readouterr().err
    steps = json.loads((out / "summary.json").read_text())["steps"]
    assert [one["dense"]["file"] for one in steps] == ["dense/step_0000.nc", "dense/step_0001.nc", None]


def test_a_dense_step_that_is_no_denser_is_refused(
    originals: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(originals, tmp_path / "results", dense="12")) == 1
    assert "--dense 12 is more than --step 10" in capsys.readouterr().err
