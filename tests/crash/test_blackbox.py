"""The command line on pictures of a rig that the product has never seen, made by code that shares nothing with it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray

from stereorig.core.cameras.camera import ELEVEN_PARAMETER_NAMES
from stereorig.server.cli import main
from tests.support.independent_rig import FLAT, LineGrid, PlainCamera, Waves, render

deg = np.deg2rad
CAM1 = PlainCamera((512, 480), 12100.0, 260.0, 236.0, 2.1e-9, 0.9617, deg(44), deg(0.8), deg(-29.0), 0.2, -0.1, 401.0)
CAM2 = PlainCamera((512, 480), 11930.0, 251.5, 243.0, -3e-9, 0.9617, deg(46.2), deg(-0.5), deg(30.5), -0.15, 0.1, 398.0)

TARGET = """
pitch_mm = 1.0
lines = [11, 11]
line_width_mm = 0.03
node_tolerance_mm = 0.0
dark_lines = true
"""

RIG = """
[cam1]
image_size_px = [512, 480]
phd_px = 12000
standoff_mm = 400
angle_deg = -30
aspect = 0.9617
[cam2]
image_size_px = [512, 480]
phd_px = 12000
standoff_mm = 400
angle_deg = 30
aspect = 0.9617
"""


def calibration_file(folder: Path) -> Path:
    """A file that holds only what the format asks for."""
    cams = {}
    for name, cam in (("cam1", CAM1), ("cam2", CAM2)):
        values = list(asdict(cam).values())[1:]
        cams[name] = dict(zip(ELEVEN_PARAMETER_NAMES, values, strict=True))
    path = folder / "true.json"
    path.write_text(json.dumps(cams))
    return path


@pytest.mark.normal_depth("profile")
@pytest.mark.parametrize("localiser", ["profile", "paper"])
def test_calibrate_finds_the_rig_from_pictures(tmp_path: Path, localiser: str) -> None:
    views = tmp_path / "views"
    views.mkdir()
    grid = LineGrid(1.0, (11, 11), 0.03)
    for i, dz in enumerate((0.0, 2.0, 4.0, 5.0)):
        for j, (name, cam) in enumerate((("cam1", CAM1), ("cam2", CAM2))):
            image = render(cam, grid, dz=dz, n=8, low=15.0, high=230.0, seed=10 * i + j)  # backlit: high contrast
            tifffile.imwrite(views / f"{name}_{dz:+.3f}mm.tif", image)
    (tmp_path / "target.toml").write_text(TARGET)
    (tmp_path / "rig.toml").write_text(RIG)
    out = tmp_path / "calibration.json"
    status = main(
        [
            "calibrate",
            str(views),
            "--target",
            str(tmp_path / "target.toml"),
            "--rig",
            str(tmp_path / "rig.toml"),
            "--hold-out",
            "2,4",
            "--localiser",
            localiser,
            "--out",
            str(out),
        ]
    )
    assert status == 0
    found = json.loads(out.read_text())
    limit = 0.0035 if localiser == "profile" else 0.006
    assert found["checks"]["held_out"]["rbe_px"] < limit
    assert {"rbe_px", "raz_mm", "nsce", "per_camera"} <= set(found["checks"]["fitted"])

    # compared in space: true image points of true points, triangulated by the calibration that was found
    points = np.stack(np.meshgrid(*[np.linspace(-4.0, 4.0, 5)] * 2, [-1.0, 0.0, 1.0]), -1).reshape(-1, 3)
    rows, sides = [], []
    for name, cam in (("cam1", CAM1), ("cam2", CAM2)):
        p = found[name]
        mine = PlainCamera(
            cam.size,
            *[
                p[k]
                for k in (
                    "phd_px",
                    "cx_px",
                    "cy_px",
                    "kappa_per_px2",
                    "aspect",
                    "alpha_rad",
                    "beta_rad",
                    "gamma_rad",
                    "x0_mm",
                    "y0_mm",
                    "z0_mm",
                )
            ],
        )
        h = 1e-4
        base = mine.project(points)
        jac = np.stack([(mine.project(points + np.eye(3)[k] * h) - base) / h for k in range(3)], -1)
        rows.append(jac)
        sides.append(cam.project(points) - base)
    J, r = np.concatenate(rows, 1), np.concatenate(sides, 1)
    error = np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(J, r, strict=True)])
    print(
        f"{localiser}: held-out RBE {found['checks']['held_out']['rbe_px']:.5f} px, space error rms "
        f"{np.sqrt((error**2).mean(0)) * 1e3} um"
    )
    assert np.sqrt((error**2).mean(0)).max() < 1.5e-3


def test_measure_finds_motion_from_pictures(tmp_path: Path) -> None:
    texture = Waves(0.25, seed=3)
    angle = deg(2.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    shift = np.array([0.30, -0.20, 0.15])
    states = [(FLAT, np.zeros(3)), (FLAT, np.array([0.0113, 0.0071, -0.0205])), (turn @ FLAT, shift)]
    for k, (frame, origin) in enumerate(states):
        for j, (name, cam) in enumerate((("a", CAM1), ("b", CAM2))):
            tifffile.imwrite(
                tmp_path / f"{name}_{k}.tif", render(cam, texture, frame=frame, origin=origin, seed=7 * k + j)
            )
    out = tmp_path / "out"
    status = main(
        [
            "measure",
            "--cam1",
            str(tmp_path / "a_*.tif"),
            "--cam2",
            str(tmp_path / "b_*.tif"),
            "--calibration",
            str(calibration_file(tmp_path)),
            "--roi",
            "150,150,360,330",
            "--subset",
            "21",
            "--step",
            "15",
            "--out",
            str(out),
        ]
    )
    assert status == 0
    with xarray.open_dataset(out / "step_0000.nc") as shape:
        ok = shape["status"].values == 0
        assert ok.mean() > 0.99
        z = shape["z_mm"].values[ok]
        assert shape["x_px"].values[0, 0] == 150
        assert shape["x_px"].shape == (13, 15)
    assert np.sqrt((z**2).mean()) < 0.30e-3
    for k, (frame, origin) in list(enumerate(states))[1:]:
        with xarray.open_dataset(out / f"step_000{k}.nc") as field:
            ok = field["status"].values == 0
            assert ok.mean() > 0.99
            xyz = np.stack([field[f"{c}_mm"].values for c in "xyz"], -1)[ok]
            uvw = np.stack([field[f"{c}_mm"].values for c in "uvw"], -1)[ok]
        # the measured reference position carries its own error: the true motion is taken at the true plane point
        truth = xyz[:, :2] @ frame.T + origin - np.column_stack([xyz[:, :2], np.zeros(len(xyz))])
        error = (uvw - truth) * 1e3
        print(f"step {k}: mean {error.mean(0)} um, sd {error.std(0)} um")
        assert np.abs(error.mean(0)).max() < 0.15
        assert error.std(0).max() < 0.6
    summary = json.loads((out / "summary.json").read_text())
    assert summary
