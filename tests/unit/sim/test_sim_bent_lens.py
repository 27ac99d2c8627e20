"""A simulated rig with thin prisms and tilted sensors, from its file over its images to a calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereorig.server.formats.calibrations.from_folder import calibrate_folder
from stereorig.sim.optics.lens import image_of
from stereorig.sim.rig import SimRig
from tests.support.board_views import rig_views, write_views
from tests.support.calibration_rigs import aligned_rms_um
from tests.support.small_board_rig import SMALL_BOARD

BENT = (
    SMALL_BOARD.replace("k1 = -0.05\n", "k1 = -0.05\ns1 = 4e-3\ns3 = -3e-3\ntau_x_rad = 0.06\ntau_y_rad = -0.03\n")
    .replace("k1 = -0.055\n", "k1 = -0.055\ns1 = -3e-3\ns4 = 2e-3\ntau_x_rad = -0.04\ntau_y_rad = 0.05\n")
    .replace("bow_mm = 0.03", "bow_mm = 0.0")
    .replace("pitch_error = 1.0e-4", "pitch_error = 0.0")
)


@pytest.mark.timeout(300)
def test_a_rig_with_prisms_and_tilted_sensors_is_rendered_found_and_calibrated(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(BENT)
    rig = SimRig.from_toml(tmp_path / "rig.toml")
    cameras = rig.cam1.camera, rig.cam2.camera
    views = rig_views(rig, hand=range(9))
    x, y, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-30.0, 30.0, 5)] * 2, [-10.0, 0.0, 10.0]))
    points = np.column_stack([x, y, z])
    errors_um = []
    for lens in ("auto", "opencv8"):
        folder = write_views(tmp_path / lens, views, rig.target, cameras, lens=lens)
        result = calibrate_folder(folder, folder / "target.toml", folder / "rig.toml").result
        seen = [image_of(camera, points) for camera in cameras]
        errors_um.append(aligned_rms_um(result.pair.triangulate(*seen).xyz_mm, points))
        if lens == "auto":
            assert result.verdict.level == "good", result.verdict.reasons
            assert "tilted" in result.lens.model
            assert errors_um[0] < 1e3 * result.uncertainty.shape_rms_mm
    # 8 to 10 times as much by a lens that has neither
    assert errors_um[1] > 5.0 * errors_um[0], errors_um
