"""The script of the closed loop, run as it is printed: a load frame driven by the live extensometer."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from stereorig.sim.load_frame import LoadFrame
from tests.support.document_scripts import one_block
from tests.support.patience import Deadline
from tests.support.requirements import ROOT
from tests.support.service_rig import SMALL, new_test, served, true_cameras, wait_for_rig

PAGE = "docs/tutorial/closed_loop.md"
API = "/api/v1"
pytestmark = pytest.mark.timeout(300)


def test_the_printed_script_has_sixty_lines_at_most() -> None:
    assert len(one_block(PAGE, "python", "READ:GAUGE").strip().splitlines()) <= 60


def test_a_constant_strain_rate_within_twice_its_uncertainty_and_a_hold_where_no_value_holds(tmp_path: Path) -> None:
    text = SMALL.replace("[sim]\n", "[live]\ntcp_port = 0\n\n[sim]\n", 1)
    with Service(parse_config(text), tmp_path / "data") as own, served(own) as client:
        wait_for_rig(client)
        sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(true_cameras(SMALL)))})
        test_id = new_test(client, name="strip", calibration_id=str(sent.json()["id"]))

        def pull(strain: float) -> None:
            client.put(f"{API}/sim/scene", json={"scene": "strip", "load": 100.0 * strain}).raise_for_status()

        pull(0.0)
        client.post(f"{API}/tests/{test_id}/steps", json={"label": "reference"}).raise_for_status()
        gauge = {"name": "e1", "a_px": [128, 85], "b_px": [128, 155]}
        body = {"extensometers": [gauge], "silence_ms": 1500}  # a busy machine's frames are late, and hold too
        client.post(f"{API}/tests/{test_id}/live", json=body).raise_for_status()
        until = Deadline(120.0)
        while (live := client.get(f"{API}/tests/{test_id}/live").json())["values"]["number"] < 3:
            assert until.left, live
            time.sleep(0.05)
        with LoadFrame(pull) as frame:
            script = one_block(PAGE, "python", "READ:GAUGE")
            script = script.replace("5025", str(live["tcp_port"])).replace("5026", str(frame.port))
            (tmp_path / "script.py").write_text(script, encoding="utf-8")
            program = subprocess.Popen(
                [sys.executable, "script.py"],
                cwd=tmp_path,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            faults = own.rig.pair.units["cam2"].grabber.faults  # type: ignore[attr-defined]

            def lose() -> None:
                until = Deadline(60.0)
                while len(frame.strains) < 5 and until.left:  # the ramp goes on
                    time.sleep(0.05)
                time.sleep(3.0)
                faults.gone = True  # it is connected again by itself once it is there
                time.sleep(1.0)
                faults.gone = False

            losing = threading.Thread(target=lose)
            losing.start()
            out, err = program.communicate(timeout=150.0)
            losing.join()
            known_s, known = np.array(frame.strains).T
        client.post(f"{API}/tests/{test_id}/live:stop")
    assert program.returncode == 0, (out, err)
    rows = np.array(re.findall(r"^(\S+) s ramp (\S+) strain (\S+) u (\S+) off", out, re.MULTILINE), dtype=float)
    assert len(rows) > 10, out
    at, ramp, seen, u = rows[rows[:, 1] > 3e-5 * 2.0].T
    # what the scene was last put to before the exposure
    true = known[np.searchsorted(known_s, at, side="right") - 1]
    # the specimen follows the ramp, and does so better than one value tells
    assert np.mean(np.abs(true - ramp) < 2.0 * u) >= 0.95, out
    # a value has its own noise besides, 0.7 u: one in two hundred lies beyond, and of thirty none or one
    assert np.mean(np.abs(seen - ramp) < 2.0 * u) > 0.9, out
    # the values scatter about the truth by less than their uncertainty, of which the reference's half was taken off
    assert np.sqrt(np.mean(((seen - true) / u) ** 2)) < 1.1, out
    assert "hold: " in out
    assert known[-1] == pytest.approx(3e-5 * 15.0, rel=0.25)
