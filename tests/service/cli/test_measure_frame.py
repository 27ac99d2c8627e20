"""``stereorig measure --frame``: the files are in the frame that is asked for, and say so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from stereorig.server.cli import main
from tests.support.copied_tests import write_test_folder

# X along the system's Y, Y against its X, from another origin
TURNED = {"kind": "given", "rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "origin_mm": [1.0, 2.0, 0.5]}
ARGUMENTS = ["--roi", "45,45,105,95", "--subset", "21", "--step", "12", "--strain", "off"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("taken") / "t000001-abcdef"
    write_test_folder(made, 2, load_a_step=300.0)
    return made


def results(out: Path) -> tuple[dict[str, Any], dict[str, Any], str]:
    """The last step's variables, the summary, and the frame that the file states."""
    with xarray.open_dataset(out / "step_0001.nc") as data:
        held = {name: np.array(data[name]) for name in ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm", "covariance")}
        return held, json.loads((out / "summary.json").read_text()), str(data.attrs["frame"])


def test_files_are_written_in_the_frame_that_is_asked_for(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["measure", str(folder), *ARGUMENTS, "--out", str(tmp_path / "plain")]) == 0
    asked = ["--frame", json.dumps(TURNED), "--out", str(tmp_path / "turned")]
    capfd.readouterr()
    assert main(["measure", str(folder), *ARGUMENTS, *asked]) == 0
    plain, plain_summary, plain_frame = results(tmp_path / "plain")
    turned, summary, frame = results(tmp_path / "turned")
    # numbers are stored as 32 bit: 1e-5 mm at these coordinates
    np.testing.assert_allclose(turned["x_mm"], plain["y_mm"] - 2.0, atol=1e-5)
    np.testing.assert_allclose(turned["y_mm"], -(plain["x_mm"] - 1.0), atol=1e-5)
    np.testing.assert_allclose(turned["z_mm"], plain["z_mm"] - 0.5, atol=1e-5)
    np.testing.assert_allclose(turned["u_mm"], plain["v_mm"], atol=1e-6)
    np.testing.assert_allclose(turned["v_mm"], -plain["u_mm"], atol=1e-6)
    np.testing.assert_allclose(turned["w_mm"], plain["w_mm"], atol=1e-6)
    assert np.nanmax(np.abs(plain["w_mm"])) > 0.01
    assert frame.startswith("aligned by given axes")
    assert plain_frame in frame
    assert (plain_summary["frame"], summary["frame"]) == (plain_frame, frame)
    assert f"frame of the files: {frame}" in capfd.readouterr().err
    # nothing is measured for a frame that is none
    assert main(["measure", str(folder), *ARGUMENTS, "--frame", "sideways", "--out", str(tmp_path / "none")]) == 1
    assert "frame_invalid" in capfd.readouterr().err
    assert not (tmp_path / "none").exists()
