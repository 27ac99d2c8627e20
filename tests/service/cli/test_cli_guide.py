"""``stereorig guide`` on a running service with a simulated rig: by itself, line by line, to the goal."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.service_rig import data_of, served, wait_for_rig
from tests.support.small_board_rig import SMALL_BOARD


def test_runs_by_itself_to_the_goal_and_says_what_it_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "calibration.json"
    # six views are the least that can be checked; the goal is met with fewer
    with Service(parse_config(SMALL_BOARD), data_of(tmp_path)) as service, served(service) as client:
        wait_for_rig(client)
        url = str(client.base_url).rstrip("/")
        assert main(["guide", "--url", url, "--goal-um", "6", "--out", str(out)]) == 0
    text = "".join(capsys.readouterr())
    assert "holds the target where the specimen will be" in text
    assert "the uncertainty of Z at your specimen goes from" in text
    assert "the goal of 6 um is met" in text
    assert "verdict: " in text
    made = json.loads(out.read_text())
    assert made["stage"]["moves"] == "free"
    assert len({v["frame"] for v in made["views"]}) == 6


def test_refuses_goals_that_mean_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["guide", "--goal-um", "-1"]) == 1
    assert "--goal-um" in capsys.readouterr().err
    assert main(["guide", "--views", "2"]) == 1
    assert "at least three poses" in capsys.readouterr().err
