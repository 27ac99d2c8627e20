"""``stereorig measure --patch``: a sphere whose skin then bends, on rendered images with a known truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from stereorig.core.names import CAMERAS
from stereorig.server.cli import main
from stereorig.server.formats.images import write_image
from stereorig.server.formats.results.reading import read_field
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import sphere
from stereorig.sim.truth import truth_at
from tests.support.measure_command import command, small_rig

# a sphere of 30 mm; it moves as a block; then its skin straightens to 90 mm and goes back
STATES = ("still", "moved", "bent", "moved")


def scene(rig: SimRig, state: str) -> Scene:
    if state == "bent":
        texture = make_scene(rig, "sphere").texture
        return Scene(name="sphere", surface=sphere(90.0), texture=texture, sys_from_body=UPRIGHT)
    motion = {"translation_mm": (0.03, -0.02, 0.05), "rotation_rad": (0.0, 0.0, 0.004)}
    return make_scene(rig, "sphere", load=float(state == "moved"), **motion)


@pytest.fixture(scope="module")
def rig() -> SimRig:
    return small_rig()


@pytest.fixture(scope="module")
def folder(rig: SimRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sphere")
    rng = np.random.default_rng(1)
    for n, state in enumerate(STATES):
        for name in CAMERAS:
            sim = rig.camera(name)
            seen = render(scene(rig, state), sim.camera, sim.size_px, options=RenderOptions(blur_px=rig.blur_px))
            write_image(folder / f"{name}_{n}.tif", sim.sensor.expose(sim.lighting.apply(seen), rng, exposure=1.0))
    calibration = {name: rig.camera(name).camera.paper_parameters() for name in CAMERAS}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    return folder


def errors_um(rig: SimRig, data: Any, state: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of Z (n,) and, of a displacement, of u, v, w (n, 3)."""
    xy = np.stack([data["x_px"], data["y_px"]], axis=-1)
    truth = truth_at(scene(rig, "still"), rig.cam1.camera, xy, now=scene(rig, state))
    ok = data["status"].values == 0
    assert ok.mean() > 0.97
    z = (data["z_mm"].values - truth.xyz_mm[..., 2])[ok] * 1e3
    if "u_mm" not in data:
        return z, np.zeros((0, 3))
    uvw = np.stack([data["u_mm"], data["v_mm"], data["w_mm"]], axis=-1)
    return z, (uvw - truth.uvw_mm)[ok] * 1e3


def test_auto_decides_shape_and_motion_apart_keeps_to_it_and_says_why(
    rig: SimRig, folder: Path, tmp_path: Path, capfd: Any
) -> None:
    assert main(command(folder, tmp_path / "out", patch="auto")) == 0
    printed = capfd.readouterr().err
    assert "shape: quadratic: plane patches have a bias of" in printed
    assert "step 1: affine: plane patches have a bias of less than" in printed
    assert "step 2: quadratic: plane patches have a bias of" in printed
    steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    assert [step["patch"]["patch"] for step in steps] == ["quadratic", "affine", "quadratic", "quadratic"]
    assert [step["patch"]["kept"] for step in steps] == [False, False, False, True]
    assert all(step["patch"]["asked"] == "auto" for step in steps)
    # 1.8 um along Z, a tenth and more of it along the ray besides
    assert 1.5e-3 < steps[0]["patch"]["plane_error_mm"] < 2.5e-3
    for n, state in enumerate(STATES):
        path = tmp_path / "out" / f"step_{n:04d}.nc"
        with xr.open_dataset(path) as data:
            assert data.attrs["patch"] == steps[n]["patch"]["patch"]
            assert data.attrs["patch_reason"] == steps[n]["patch"]["reason"]
            assert json.loads(data.attrs["patch_choice"]) == steps[n]["patch"]
            z, uvw = errors_um(rig, data, state)
            assert abs(z.mean()) < 0.1
            if n:
                assert np.abs(uvw.mean(0)).max() < 0.15
                assert np.sqrt((uvw**2).mean()) < (0.35 if state == "moved" and n == 1 else 0.6)
            assert ("curvature_1" in data) == (data.attrs["patch"] == "quadratic")
            if "curvature_1" in data:
                mean = 0.5 * (data["curvature_1"] + data["curvature_2"])
                assert abs(30.0 * float(mean.mean()) - 1.0) < 0.05
                assert data["curvature_1"].attrs["units"] == "mm-1"
        assert read_field(path).patch is not None


def test_plane_patches_asked_for_are_taken_and_their_error_is_said(
    rig: SimRig, folder: Path, tmp_path: Path, capfd: Any
) -> None:
    two = {cam: [str(folder / f"{cam}_{n}.tif") for n in (0, 2)] for cam in ("cam1", "cam2")}
    assert main(command(folder, tmp_path / "out", patch="affine", **two)) == 0
    printed = capfd.readouterr().err
    assert "shape: plane: asked for; plane patches have a bias of" in printed
    assert "step 1: affine: asked for; plane patches have a bias of" in printed
    assert printed.count("quadratic ones would have the smaller total error") == 2
    with xr.open_dataset(tmp_path / "out" / "step_0000.nc") as data:
        z, _ = errors_um(rig, data, "still")
        choice = json.loads(data.attrs["patch_choice"])
        assert choice["quadratic_advised"]
        # its own estimate, against the truth: the error is along camera 1's ray, 30 degrees from Z
        assert abs(choice["plane_error_mm"] * 1e3 * np.cos(np.radians(30.0)) / abs(z.mean()) - 1.0) < 0.1
        assert "curvature_1" not in data


def test_curved_patches_asked_for_are_taken_for_both(rig: SimRig, folder: Path, tmp_path: Path) -> None:
    assert main(command(folder, tmp_path / "out", patch="quadratic")) == 0
    for n, state in enumerate(STATES):
        with xr.open_dataset(tmp_path / "out" / f"step_{n:04d}.nc") as data:
            assert data.attrs["patch_reason"] == "quadratic: asked for"
            z, uvw = errors_um(rig, data, state)
            assert abs(z.mean()) < 0.1
            assert uvw.size == 0 or np.abs(uvw.mean(0)).max() < 0.15


def test_an_unknown_patch_is_refused(folder: Path, tmp_path: Path, capfd: Any) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(command(folder, tmp_path / "out", patch="bent"))
    assert stopped.value.code == 2
    assert "quadratic" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_step_states_what_its_patches_are_off_by(rig: SimRig, folder: Path, tmp_path: Path) -> None:
    assert (
        main(
            command(
                folder,
                tmp_path / "out",
                patch="affine",
                cam1=str(folder / "cam1_[01].tif"),
                cam2=str(folder / "cam2_[01].tif"),
            )
        )
        == 0
    )
    steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    with xr.open_dataset(tmp_path / "out" / "step_0000.nc") as data:
        assert json.loads(data.attrs["systematic"]) == steps[0]["systematic"]
        off = float(np.mean(errors_um(rig, data, "still")[0]))
    stated = steps[0]["systematic"]["patch_order"]["figures"]["z_um"]
    # the mean over the field leaves little noise, and perspective little variation of the curvature
    assert stated["rms"] == pytest.approx(abs(off), rel=0.25)
    assert steps[0]["systematic"]["strain_window"] is None
    # a block's motion is no work for higher orders
    moved = steps[1]["systematic"]["patch_order"]["figures"]["w_um"]
    assert moved["below"] < 0.3 * stated["rms"]
    assert steps[1]["systematic"]["interpolation"]["text"]
