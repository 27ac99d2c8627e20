"""A data folder with a test that was measured, its service ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, plate_test, served, wait_for_job, wait_for_rig

API = "/api/v1"
BODY: dict[str, Any] = {"region": {"rectangle": [80, 80, 160, 150]}, "subset_px": 21, "spacing_px": 8}


def measured_test(data: Path) -> tuple[str, str]:
    """Make a test of the plate with a reference and two loads, and measure it with strain; return both ids."""
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            test_id = plate_test(client)
            for load in (0.5, 1.0):
                client.put(f"{API}/sim/scene", json={"scene": "plate", "load": load}).raise_for_status()
                client.post(f"{API}/tests/{test_id}/steps", json={"label": f"load {load}"}).raise_for_status()
            accepted = client.post(f"{API}/tests/{test_id}/analyses", json=BODY).json()
            done = wait_for_job(client, accepted["job"])
            assert done["state"] == "succeeded", done["problem"]
    finally:
        service.close()
    return test_id, str(accepted["analysis_id"])
