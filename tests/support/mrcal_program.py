"""Calibrate by mrcal; run by Debian's own Python, where its package lies, data by file: program in.npz out.npz.

In: ``lensmodel``, ``intrinsics`` (2, n), ``rt21`` (6,), ``frames`` (f, 6), ``observations`` (2 f, rows, columns, 3),
``spacing``, ``sizes`` (2, 2), ``warp``. Out: the same three found, and ``covariance`` of both intrinsics and ``rt21``
with one unit of noise on every weighted coordinate.
"""

import sys

import mrcal
import numpy as np

given = np.load(sys.argv[1])
n_frames = len(given["frames"])
index = np.array([(k, c, c - 1) for k in range(n_frames) for c in range(2)], dtype=np.int32)
inputs = {
    "intrinsics": given["intrinsics"].copy(),
    "extrinsics_rt_fromref": given["rt21"].reshape(1, 6).copy(),
    "frames_rt_toref": given["frames"].copy(),
    "points": None,
    "observations_board": given["observations"].copy(),
    "indices_frame_camintrinsics_camextrinsics": index,
    "observations_point": None,
    "indices_point_camintrinsics_camextrinsics": None,
    "lensmodel": str(given["lensmodel"]),
    "imagersizes": given["sizes"].astype(np.int32),
    "calobject_warp": np.zeros(2) if given["warp"] else None,
    "do_optimize_calobject_warp": bool(given["warp"]),
    "calibration_object_spacing": float(given["spacing"]),
    "do_apply_regularization": False,
    "do_apply_outlier_rejection": False,
    "verbose": False,
}
mrcal.optimize(**inputs)
J = mrcal.optimizer_callback(**inputs)[2].toarray()
mrcal.pack_state(J, **inputs)
J = J[: 2 * inputs["observations_board"][..., 0].size]
scale = 1.0 / np.linalg.norm(J, axis=0)
Q, Rq = np.linalg.qr(J * scale)
inverse = np.linalg.solve(Rq, np.eye(len(Rq))) * 1.0
covariance = (inverse @ inverse.T) * scale[:, None] * scale
size = 2 * inputs["intrinsics"].shape[1] + 6
np.savez(
    sys.argv[2],
    intrinsics=inputs["intrinsics"],
    rt21=inputs["extrinsics_rt_fromref"][0],
    frames=inputs["frames_rt_toref"],
    covariance=covariance[:size, :size],
)
