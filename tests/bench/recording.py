"""Record simulated cameras of 512 x 480 px at 200 Hz: 10 s, 1 s of them before the call; print what became of every pair.

``python -m tests.bench.recording`` starts a service of its own, with all of its processes.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx

from tests.support.tiny_rig import TINY

RATE_HZ, BEFORE_S, AFTER_S = 200.0, 1.0, 9.0


def rig_file() -> str:
    """Return the tiny rig with fast cameras."""
    text = (
        TINY.replace("[160, 144]", "[512, 480]").replace("3600.0", "11520.0").replace("cx_px = 80.4", "cx_px = 256.4")
    )
    text = text.replace("cx_px = 79.7", "cx_px = 255.7").replace("cy_px = 71.8", "cy_px = 239.8")
    text = text.replace("cy_px = 72.1", "cy_px = 240.1").replace("exposure_ms = 10.0", "exposure_ms = 2.0")
    return text.replace("max_skew_ms = 1.0", f'max_skew_ms = 2.0\ntrigger = "free"\nframe_rate_hz = {RATE_HZ}')


def main() -> int:
    """Run it."""
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        rig = Path(folder, "rig.toml")
        rig.write_text(rig_file(), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "stereorig.server.cli",
            "serve",
            "--config",
            str(rig),
            "--data",
            f"{folder}/data",
        ]
        with subprocess.Popen([*command, "--port", str(port)], stdin=subprocess.DEVNULL) as service:
            try:
                _measure(f"http://127.0.0.1:{port}/api/v1")
            finally:
                service.terminate()
    return 0


def _measure(base: str) -> None:
    with httpx.Client(base_url=base, timeout=600.0, trust_env=False) as client:
        until = time.monotonic() + 120.0
        while time.monotonic() < until:
            try:
                if client.get("/rig").json()["connected"]:
                    break
            except httpx.HTTPError:
                pass
            time.sleep(0.5)
        time.sleep(10.0)  # the images of the scene are made, and the stage is homed
        test = client.post("/tests", json={"name": "recording"}).json()["id"]
        job = client.post(f"/tests/{test}/record", json={"before_s": BEFORE_S, "after_s": AFTER_S})
        print(job.status_code, job.json().get("detail", ""))
        time.sleep(BEFORE_S + 1.0)
        client.post(f"/tests/{test}/record:trigger").raise_for_status()
        began = time.monotonic()
        while (found := client.get(f"/jobs/{job.json()['job']['id']}").json())["state"] in ("running", "queued"):
            time.sleep(0.5)
        result = found["result"] or {}
        steps = result.pop("steps", [])
        print(json.dumps({k: v for k, v in result.items() if k != "account"}), found["state"], found.get("problem"))
        print(json.dumps(result.get("account"), indent=1))
        count = result.get("n_steps", len(steps))
        print(
            f"{count} steps of {round(RATE_HZ * (BEFORE_S + AFTER_S))}, {time.monotonic() - began:.1f} s to the last step"
        )


if __name__ == "__main__":
    raise SystemExit(main())
