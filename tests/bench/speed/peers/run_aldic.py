"""Runs in the peer's own environment and imports nothing of this project but ``job.py``: pyALDIC-3D on the files that a job names.

Everything is done as its users do it without a window: ``al-dic-3d run CONFIG``, from image files and a calibration of OpenCV's
to an archive, called in one process. Its nodes are its own: they lie centred in the region, as far from one another as the job says.
"""

from __future__ import annotations

import contextlib
import io
import json
from importlib.metadata import version
from pathlib import Path

from job import measure_runs, read_job

JOB = read_job()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from al_dic_3d.cli import main as al_dic_3d  # noqa: E402


def write_calibration(path):
    """The pair as ``cv2.stereoCalibrate``'s users write it; K has a skew there, so nothing is lost."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for n, cam in enumerate((JOB["cam1"], JOB["cam2"]), start=1):
        file.write(
            f"cameraMatrix{n}",
            np.array([[cam["fx"], cam["skew"], cam["cx"]], [0.0, cam["fy"], cam["cy"]], [0.0, 0.0, 1.0]]),
        )
        file.write(f"distCoeffs{n}", np.array(cam["distortion"]).reshape(1, -1))
    file.write("R", np.array(JOB["rotation"]))
    file.write("T", np.array(JOB["translation_mm"]).reshape(3, 1))
    file.release()


def config_text(run, calibration, out):
    """The run's configuration, TOML; JSON's strings, numbers, lists and truth values are TOML's too."""
    x0, y0, x1, y1 = run["region_px"]
    last = run["steps"] + 1
    # its window reaches half its size to both sides: 32 is 33 px wide
    matching = {"winsize": run["subset_px"] - 1, "winstepsize": JOB["spacing_px"], **run["options"]}
    if matching.get("init_guess") == "seed":
        matching["seed_point"] = [(x0 + x1) // 2, (y0 + y1) // 2]
    tables = {
        "calibration": {"file": str(calibration), "format": "opencv_yaml"},
        "sequence": {"left": JOB["files1"][:last], "right": JOB["files2"][:last]},
        "roi": {"xmin": x0, "xmax": x1, "ymin": y0, "ymax": y1},
        "matching": matching,
        "output": {"dir": str(out), "prefix": "run"},
    }
    lines = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def measure(run, out):
    config = out / "config.toml"
    config.write_text(config_text(run, Path(JOB["folder"]) / "calibration_opencv.yml", out))
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = al_dic_3d(["run", str(config), "--quiet", "--formats", "npz"])
    if status != 0:
        raise RuntimeError(printed.getvalue())


def read_fields(run, out):
    """Nodes, positions and displacements; its world is the left camera."""
    with np.load(out / "run.npz") as found:
        x, y = found["ref_coords"].T
        return {"x": x, "y": y, "xyz": found["points3D"][0], "uvw": found["displacement3D"][1:]}


if __name__ == "__main__":
    write_calibration(Path(JOB["folder"]) / "calibration_opencv.yml")
    measure_runs(JOB, version("al-dic-3d"), measure, read_fields)
