"""The plan of the how-to for bluesky, run as it is printed against the simulated rig."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import stereorig
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.document_scripts import WRITTEN, one_block, run
from tests.support.service_rig import SMALL, served, true_cameras, wait_for_rig

PAGE = "docs/tutorial/bluesky.md"
MISSING = [name for name in ("bluesky", "ophyd_async") if importlib.util.find_spec(name) is None]


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    service = Service(parse_config(SMALL), tmp_path_factory.mktemp("bluesky") / "data").start()
    try:
        with served(service) as made:
            wait_for_rig(made)
            at = str(made.base_url).rstrip("/")
            cameras = tmp_path_factory.mktemp("cameras") / "calibration.json"
            cameras.write_text(json.dumps(true_cameras(SMALL)), encoding="utf-8")
            with stereorig.Client(at, progress=False) as client:
                client.import_calibration(cameras, accept=True)
            yield at
    finally:
        service.close()


@pytest.mark.deep
@pytest.mark.skipif(
    bool(MISSING) and os.environ.get("CI") != "true",
    reason=f"{' and '.join(MISSING)} not installed: pip install '.[dev]' brings them",
)
def test_the_plan_loads_until_the_plate_has_surely_moved_far_enough(url: str, tmp_path: Path) -> None:
    text = one_block(PAGE, "python", "RunEngine")
    # the small rig's pixels, and as few points as show the plate's middle
    small = "[90, 80, 420, 400]", "[105, 95, 150, 140]"
    for of_page, here in ((WRITTEN, url), small):
        assert of_page in text
        text = text.replace(of_page, here)
    (tmp_path / "script.py").write_text(text, encoding="utf-8")
    done = run([sys.executable, "script.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    lines = re.findall(r"^(\d+) kPa: W (\S+) mm, standard uncertainty (\S+) mm$", done.stdout, re.MULTILINE)
    # of the clamped plate's 0.117 mm at 689 kPa (linear), 0.05 mm are passed between 172 and 344 kPa
    assert [float(load) for load, _, _ in lines] == [0.0, 172.0, 344.0]
    assert [float(w) for _, w, _ in lines] == pytest.approx([0.0, -0.029, -0.058], abs=0.006)
    assert all(0.0 < float(sigma) < 0.005 for _, _, sigma in lines[1:])
    assert "stopped at 344.0 kPa, success" in done.stdout
    assert done.stdout.count("event {") == 3
    assert "'pressure-kpa': 344.0" in done.stdout
