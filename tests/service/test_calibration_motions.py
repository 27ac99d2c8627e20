"""Calibrations by one stage axis, under the target or under both cameras, over the API on a simulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.service_rig import data_of, served, wait_for_job, wait_for_rig
from tests.support.small_board_rig import SMALL_BOARD

API = "/api/v1"
# as the file has it: the way of the target against the cameras, in the frame of the target at dZ = 0
DIRECTION = np.array([0.012, -0.008, 1.0]) / np.linalg.norm([0.012, -0.008, 1.0])


def rig_text(moves: str) -> str:
    """Return the small board rig with one axis that moves what is named, over enough travel for its few pixels."""
    return (
        SMALL_BOARD.replace('moves = "target"', f'moves = "{moves}"')
        .replace("positions_mm = [0.0, 10.0]", "positions_mm = [-10.0, 0.0, 10.0]")
        .replace("bow_mm = 0.03", "bow_mm = 0.0")
        # measured on its own, as a stage does not determine it
        .replace("angle_deg = -12.5", "angle_deg = -12.5\naspect = 1.0005")
        .replace("angle_deg = 12.5", "angle_deg = 12.5\naspect = 1.0003")
    )


@pytest.mark.timeout(300)
@pytest.mark.normal_depth("target")
@pytest.mark.parametrize("moves", ["target", "both_cameras"])
def test_one_axis_calibrates_over_the_api(tmp_path: Path, moves: str) -> None:
    config = parse_config(rig_text(moves))
    with Service(config, data_of(tmp_path)) as service, served(service) as client:
        wait_for_rig(client)
        rig = client.get(f"{API}/rig").json()
        assert [axis["cameras"] for axis in rig["stage"]["axes"]] == [["cam1", "cam2"]]
        answer = client.post(f"{API}/calibrations", json={})
        assert answer.status_code == 202, answer.text
        ended = wait_for_job(client, answer.json()["job"], seconds=200.0)
        assert ended["state"] == "succeeded", ended["problem"]
        made: dict[str, Any] = client.get(f"{API}/calibrations/{answer.json()['calibration_id']}").json()
    assert made["state"] == "complete"
    assert made["verdict"]["level"] == "good", made["verdict"]["reasons"]
    assert made["stage"]["moves"] == moves
    found, sigma = made["stage"]["direction_sys"], np.array(made["stage"]["direction_sigma_rad"])
    # three reported sigmas; the aspect is stated to 1e-4, which is worth as much of an angle
    np.testing.assert_allclose(found, DIRECTION, atol=3.0 * sigma.max() + 1e-4)
    assert sigma.max() < 3.1e-3
