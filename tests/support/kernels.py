"""Compile the kernels before the tests run: several workers would each compile the same ones at the same time.

    python -m tests.support.kernels

A process a group, side by side; numba keeps what they compile on disk. What is missing here is compiled by the first
test that needs it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.support.requirements import ROOT


def measure() -> None:
    """Shapes and motions with plane patches, as a service does when it starts; line crossings."""
    import stereorig.server.compute.measurement
    from stereorig.core.field.region.cuts import Cuts, crosses

    stereorig.server.compute.measurement.compile_here(1)
    crosses([[1.0, 5.0]], [[5.0, 1.0]], Cuts([[[0.0, 0.0], [9.0, 9.0]]]))


def curved() -> None:
    """The same with quadratic patches, and a shape's cluster-robust covariance; the motion in a process beside it."""
    from stereorig.core.matching.cluster_robust import cluster_robust_covariance
    from stereorig.core.matching.fit import fit_shape
    from stereorig.core.matching.options import MatchOptions
    from tests.support.matching_scene import paper_pair

    command = [sys.executable, "-m", "stereorig.server.compute.background_compilation", "quadratic"]
    with subprocess.Popen(command, cwd=ROOT):
        picture = np.random.default_rng(1).normal(128.0, 20.0, (64, 64))
        options = MatchOptions(subset_px=21, patch="quadratic")
        pair, at = paper_pair(size=64), [[32.0, 32.0]]
        fit_shape(pair, picture, picture, at, [[np.nan] * 3], options)
        flat = [[0.0025, *[0.0] * 5]]
        cluster_robust_covariance(pair, [picture, picture], at, flat, None, [0.0], options)


def dense() -> None:
    """The windows of dense fields, over one cell of a prediction that moves nothing."""
    from stereorig.core.dense.kernels.finish import AtPoints, Limits, Shape
    from stereorig.core.dense.windows import finish_windows, measure_windows, node_positions
    from stereorig.core.field.points.prediction import Prediction
    from stereorig.core.matching.image import prepare
    from stereorig.core.matching.options import MatchOptions
    from tests.support.matching_scene import paper_pair

    picture = prepare(np.random.default_rng(1).normal(128.0, 20.0, (64, 64)))
    xy = np.stack(np.meshgrid([28.0, 36.0], [28.0, 36.0]), axis=-1)
    pair, options = paper_pair(size=64), MatchOptions(subset_px=9)
    for images in (1, 3):
        state, one = np.full((2, 2, 5), 0.0025), np.ones((2, 2, 1))
        node_positions(pair, xy, state, motion=images == 3)
        nothing = Prediction(np.zeros((4, 4, 2 * images, 4)), np.ones((3, 3), bool), np.ones((1, 1), bool), 1)
        found = measure_windows(
            pair, [picture] * (images + 1), xy, state, nothing, options, step_px=2, cuts=None, white=None
        )
        points = AtPoints(np.ones((2, 2, 1 + images // 3)), np.ones((2, 2, images)), one, one, 0.25)
        none = np.empty((0, 0))
        shape = Shape(np.empty((0, 0), np.int8), none[..., None], none[..., None, None])
        finish_windows(found, points, Limits(0.6, 0.1, 0.1, 0.1, np.ones(images)), shape)


def covariances() -> None:
    """What a measurement with a calibration's covariance and strain needs, and starts from scattered matches."""
    from stereorig.core.common.derivatives import Estimator
    from stereorig.core.field.seeding.local_fit import robust_local_fits
    from stereorig.core.strain.common_part import common_part
    from stereorig.core.strain.reduced import window_sums
    from tests.support.matching_scene import paper_pair

    rng = np.random.default_rng(1)
    points = np.column_stack([rng.normal(size=(30, 2)), np.zeros(30)])
    Estimator.at(paper_pair(size=64), points, points + 1e-3)
    robust_local_fits(points[:3, :2], points[:, :2], points[:, :2], tolerance=1.0)
    one = np.array([1])
    window_sums(rng.normal(size=(3, 3, 2)), one, one, one - 1, np.ones((1, 2, 9)), 1, from_centre=True)
    windows: Any = SimpleNamespace(status=np.zeros((3, 3), np.int8), reduced=[(one, one, np.ones((1, 2, 9)))])
    common_part(np.ones((3, 3, 6, 2), np.float32), np.ones((3, 3), bool), windows, np.ones((3, 3, 3, 12)), 1)


def targets() -> None:
    """Line grids and boards, drawn by the tests' own renderers."""
    from stereorig.core.boards import BoardTarget, detect_board
    from stereorig.core.grid import GridOptions, detect_grid
    from tests.support.board_images import BoardCamera, board_image
    from tests.support.grid_images import PAPER_TARGET, grid_image, paper_camera

    picture = grid_image(paper_camera())
    for line_model in ("straight", "local"):
        detect_grid(picture, PAPER_TARGET, options=GridOptions(line_model=line_model))  # type: ignore[arg-type]
    camera = BoardCamera()
    for kind in ("checkerboard", "circles"):
        board = BoardTarget(kind=kind, size=(9, 7), pitch_mm=5.0)  # type: ignore[arg-type]
        detect_board(board_image(camera, board), board)


def scenes() -> None:
    """Every scene of the simulated world."""
    from stereorig.server.config.rig_file import parse_config
    from stereorig.sim.catalog import SCENE_NAMES, TARGET_SCENES
    from stereorig.sim.rig import SimRig
    from stereorig.sim.world import SimWorld
    from tests.support.tiny_rig import tiny_rig

    rig = SimRig.from_dict(parse_config(tiny_rig()).model_dump(exclude_none=True))
    world = SimWorld(rig, lambda _: 0.0)
    for name in {*SCENE_NAMES, *TARGET_SCENES}:
        world.set_scene(name)
        world.expose("cam1", exposure_ms=10.0, gain_db=0.0, rng=np.random.default_rng(1))


GROUPS: dict[str, Callable[[], None]] = {f.__name__: f for f in (measure, curved, dense, covariances, targets, scenes)}


def main() -> int:
    """Run one group, or all of them side by side."""
    if len(sys.argv) > 1:
        GROUPS[sys.argv[1]]()
        return 0
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    running = [subprocess.Popen([sys.executable, "-m", __spec__.name, name], env=environment) for name in GROUPS]
    return max(process.wait() for process in running)


if __name__ == "__main__":
    raise SystemExit(main())
