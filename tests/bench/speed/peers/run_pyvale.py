"""Runs in the peer's own environment and imports nothing of this project but ``job.py``: pyvale on the files that a job names.

``python run_pyvale.py JOB.json``, the twin of ``worker.py``. Everything is done as pyvale's users do it: ``dic.calculate_3d`` from
image files to result files (binary ones, the faster form).
"""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from job import measure_runs, read_job

JOB = read_job()

import numpy as np  # noqa: E402
import pyvale.calib as calib  # noqa: E402
import pyvale.dic as dic  # noqa: E402


def angles_deg(R):
    """Angles of ``R = Rz(psi) Ry(phi) Rx(theta)`` in pyvale's order [theta, phi, psi]."""
    theta = np.arctan2(R[2, 1], R[2, 2])
    phi = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    psi = np.arctan2(R[1, 0], R[0, 0])
    return np.degrees([theta, phi, psi])


def camera(table):
    """pyvale has OpenCV's model with a skew, so nothing is lost."""
    return calib.CamIntrinsics(
        fx=table["fx"],
        fy=table["fy"],
        fs=table["skew"],
        cx=table["cx"],
        cy=table["cy"],
        distortion=np.array(table["distortion"]),
    )


def correlate(run, out):
    """One call of ``calculate_3d`` for a run of the job."""
    half = run["subset_px"] // 2
    x0, y0, x1, y1 = run["region_px"]
    columns, rows = JOB["size_px"]
    roi = np.zeros((rows, columns), dtype=bool)
    roi[y0 - half : y1 + half + 1, x0 - half : x1 + half + 1] = True
    pair = calib.Calib(
        cam0=camera(JOB["cam1"]),
        cam1=camera(JOB["cam2"]),
        translation=np.array(JOB["translation_mm"]),
        rotation=angles_deg(np.array(JOB["rotation"])),
    )
    last = run["steps"] + 1
    dic.calculate_3d(
        reference=[Path(JOB["files1"][0]), Path(JOB["files2"][0])],
        deformed=[[Path(p) for p in JOB[key][1:last]] for key in ("files1", "files2")],
        roi_mask=roi,
        calibration=pair,
        seed=[(x0 + x1) // 2, (y0 + y1) // 2],
        subset_size=run["subset_px"],
        subset_step=JOB["spacing_px"],
        num_threads=JOB["threads"],
        output_basepath=out,
        output_binary=True,
        print_level=0,
        **run["options"],
    )


def read_fields(run, out):
    """Results in the order of the points' rows."""
    found = dic.import_3d(data=str(out / "*.dic3d"), delimiter=",", binary=True, layout="column", print_level=0)
    s = found.stereo
    order = np.lexsort((found.ss_x, found.ss_y))
    # what pyvale counts as good: correlated in both cameras, with numbers
    xyz = np.stack([s.x_mm, s.y_mm, s.z_mm], axis=-1)[0]
    uvw = np.stack([s.u_mm, s.v_mm, s.w_mm], axis=-1)[1:]
    uvw = np.where((s.converged & found.converged)[1:, :, None], uvw, np.nan)
    return {"x": found.ss_x[order], "y": found.ss_y[order], "xyz": xyz[order], "uvw": uvw[:, order]}


if __name__ == "__main__":
    measure_runs(JOB, version("pyvale"), correlate, read_fields)
