"""Parameters by name: their types are those of the requests, and mypy refuses what the service would refuse."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.documents.parameters import FILES, text_of
from tests.support.requirements import ROOT

SCRIPT = """\
import numpy as np

import stereorig
from stereorig.client import AsyncClient, Client

client = Client("http://127.0.0.1:8000")
test = client.test("t000001-6fa022")
analysis = test.measure(subset_px=33, region={"rectangle": (10, 10, 90, 90)}, strain={"window": 5, "order": "auto"})
test.measure(subset_px="33")
test.measure(subset_pixels=33)
test.measure(strain={"window": 5, "tensor": "hencki"})
analysis.gauges(points=[{"xy_px": [210, 180]}], extensometers=[{"a_px": (1, 2), "b_px": [3, 4]}], k=2)
analysis.gauges(points=[{"xy": [210, 180]}])
client.calibrate(positions_mm=[0, 1, 2], frames=2)
client.calibrate(frames="two")
image = np.zeros((100, 100), dtype=np.uint8)
stereorig.Measurement("calibration.json", image, image, subset_px=33, patch="auto")
stereorig.Measurement("calibration.json", image, image, subset_px=33, patch="cubic")
"""


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.parent.name)
def test_the_types_are_those_of_the_requests(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == text_of(path), "run `python -m tests.bench.documents.parameters`"


def test_mypy_finds_each_wrong_parameter_and_no_other(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--no-pretty", str(script)]
    # the project's folder: its configuration and, after `make check`, its cache
    told = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False).stdout
    wrong = {int(line.split(":")[1]) for line in told.splitlines() if "error:" in line}
    assert wrong == {9, 10, 11, 13, 15, 18}, told
