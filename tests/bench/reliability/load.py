"""The load that a service must bear for days, for ten minutes: captures, readers, slow streams, an analysis, and stops.

A script takes 200 steps a minute into tests of 200, as one at a load frame does; before every twentieth it moves the stage,
stops it, and brings it back. Fifty readers ask for a plain document about once a second each, two read streams at 20 kB/s (a live view and all events),
and the worker analyses load steps all the time. The rig is config/sim_paper.toml; its motion controller stands in this process, where a
stop's arrival on the wire is seen by the same clock. At the end every acknowledged step is read back from disk.

    python -m tests.bench.reliability.load [--minutes 10] [--page]     # --page writes figures and plot into docs/explanation/reliability.md
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np

from stereorig.sim.controllers.esp301 import SimESP301
from tests.bench.reliability.stage_stop import TEST_ID, analysed, busy_s, homed_bench, set_priority
from tests.support.requirements import ROOT

API = "/api/v1"
PER_MINUTE = 200
READERS = 50
READ_EVERY_S = 1.0
STEPS_A_TEST = 200
STOP_EVERY = 20
REGION = {"rectangle": [60, 60, 380, 360]}
_TICK_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Load:
    """What a run showed. Times in seconds since its start, latencies in milliseconds, memory in MiB."""

    seconds: float = 0.0
    #: start of each capture's request, and how long its answer took
    captures: list[tuple[float, float]] = field(default_factory=list)
    #: how often a capture was refused and asked for again
    refused: list[str] = field(default_factory=list)
    #: acknowledged steps that were not on disk as acknowledged
    lost: list[str] = field(default_factory=list)
    gets: list[tuple[float, str, float]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    streamed: dict[str, int] = field(default_factory=dict)
    stops: list[tuple[float, float]] = field(default_factory=list)
    #: time, memory of the service, memory of its worker
    memory: list[tuple[float, float, float]] = field(default_factory=list)
    results: int = 0
    busy_share: float = 0.0
    others_share: float = 0.0

    def latency(self, share: float, kind: str | None = None) -> float:
        """Return the latency that this share of the plain reads did not exceed."""
        return percentile([ms for _, what, ms in self.gets if kind in (None, what)], share)

    def growth_mib(self, column: int) -> float:
        """Return by how much memory grew from the second third of the run to the last: of medians, in MiB."""
        last = self.seconds
        thirds = [
            [row[column] for row in self.memory if last * k / 3 <= row[0] <= last * (k + 1) / 3] for k in range(3)
        ]
        return float(np.median(thirds[2]) - np.median(thirds[1]))

    def faults(self, *, get_ms: float = 100.0, stop_ms: float = 50.0, grown_mib: float = 8.0) -> list[str]:
        """Return what does not hold of what it must."""
        found = [f"lost: {line}" for line in self.lost[:5]]
        found += [f"a reader got {line}" for line in self.wrong[:5]]
        found += [f"refused: {line}" for line in self.refused[:5]]
        asked = self.seconds / 60.0 * PER_MINUTE
        if len(self.captures) < 0.98 * asked - 1:
            found.append(f"{len(self.captures)} captures of {asked:.0f}")
        if self.latency(0.99) > get_ms:
            found.append(f"plain GET p99 {self.latency(0.99):.1f} ms, allowed {get_ms:g}")
        if self.stops and percentile([ms for _, ms in self.stops], 0.99) > stop_ms:
            found.append(f"stop p99 {percentile([ms for _, ms in self.stops], 0.99):.1f} ms, allowed {stop_ms:g}")
        for column, name in ((1, "service"), (2, "worker")):
            if self.growth_mib(column) > grown_mib:
                found.append(f"memory of the {name} grew by {self.growth_mib(column):.1f} MiB, allowed {grown_mib:g}")
        if self.results == 0:
            found.append("nothing was analysed meanwhile")
        return found


def percentile(values: list[float], share: float) -> float:
    """Return the smallest value that this share of them does not exceed."""
    ordered = sorted(values)
    return ordered[max(int(np.ceil(share * len(ordered))) - 1, 0)]


def rig_text(url: str) -> str:
    """Return the paper's rig with the stage at ``url``, and room for the stops."""
    text = (
        (ROOT / "config" / "sim_paper.toml").read_text().replace('url = "sim"', f'url = "{url}"\nhome_at_start = true')
    )
    return text.replace("velocity_mm_s = 5.0", "velocity_mm_s = 1.0").replace("settle_ms = 100", "settle_ms = 0")


def children(pid: int) -> list[int]:
    """Return a process' children."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if int(path.read_text().rsplit(")", 1)[1].split()[1]) == pid:
                found.append(int(path.parent.name))
    return found


def resident_mib(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_BYTES / 2**20


def spent_s(pids: list[int]) -> float:
    """Return the processor time that processes have used."""
    total = 0.0
    for pid in pids:
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            total += (int(fields[11]) + int(fields[12])) / _TICK_S
    return total


class Script:
    """The load frame's script: captures to a beat, and a stopped motion now and then."""

    def __init__(self, client: httpx.Client, controller: SimESP301, load: Load, readers: subprocess.Popen[str]) -> None:
        self._client, self._controller, self._load, self._readers = client, controller, load, readers
        self._dice = random.Random(50)
        self.acknowledged: list[tuple[str, int, dict[str, str]]] = []
        self._target_mm = 5.0

    def run(self, began: float, seconds: float) -> None:
        """Work until the time is over."""
        test, index = "", 0
        while (due := began + index * 60.0 / PER_MINUTE) < began + seconds:
            if index % STEPS_A_TEST == 0:
                test = self._client.post(f"{API}/tests", json={"name": f"load {index}"}).raise_for_status().json()["id"]
            if index % STOP_EVERY == STOP_EVERY - 1:
                self._stop_a_move(began)
            time.sleep(max(due - time.monotonic(), 0.0))
            self._capture(test, index, began)
            index += 1

    def _capture(self, test: str, index: int, began: float) -> None:
        body = {"load_n": float(index), "label": f"step {index}"}
        key = {"Idempotency-Key": f"load-{index}"}
        asked = time.monotonic()
        while (answer := self._client.post(f"{API}/tests/{test}/steps", json=body, headers=key)).status_code != 201:
            self._load.refused.append(f"{answer.status_code} {answer.json().get('code')}")
            if answer.status_code not in (409, 429, 503):
                answer.raise_for_status()
            time.sleep(0.02)
        self._load.captures.append((asked - began, (time.monotonic() - asked) * 1e3))
        step = answer.json()
        self.acknowledged.append((test, step["n"], step["sha256"]))
        assert self._readers.stdin is not None
        print(json.dumps({"test": test, "step": step["n"]}), file=self._readers.stdin, flush=True)

    def _stop_a_move(self, began: float) -> None:
        self._target_mm = -self._target_mm
        job = self._move(self._target_mm)
        deadline = time.monotonic() + 20.0
        while not self._controller.axis(1).moving:
            if time.monotonic() > deadline:
                raise RuntimeError(f"the move did not start: {self._client.get(f'{API}/jobs/{job}').json()}")
            time.sleep(0.001)
        time.sleep(self._dice.uniform(0.0, 0.03))
        known = len(self._controller.received)
        asked = time.monotonic()
        self._client.post(f"{API}/stage:stop").raise_for_status()
        while not (came := [entry.at_s for entry in self._controller.received[known:] if entry.text == "ST"]):
            if time.monotonic() > deadline:
                raise RuntimeError("a stop never reached the wire")
            time.sleep(0.001)
        self._load.stops.append((asked - began, (came[0] - asked) * 1e3))
        self._await_end(job)
        # back to where it measures: a simulated camera keeps the view that it has rendered there
        self._await_end(self._move(0.0))

    def _move(self, target_mm: float) -> str:
        deadline = time.monotonic() + 20.0
        body = {"positions_mm": {"1": target_mm}}
        while (answer := self._client.post(f"{API}/stage/moves", json=body)).status_code == 409:
            self._load.refused.append(f"move: {answer.json()}")
            if time.monotonic() > deadline:
                break
            time.sleep(0.02)
        return str(answer.raise_for_status().json()["job"]["id"])

    def _await_end(self, job: str) -> None:
        while self._client.get(f"{API}/jobs/{job}").json()["state"] not in ("cancelled", "succeeded", "failed"):
            time.sleep(0.002)


@contextlib.contextmanager
def analysing(base: str, data: Path) -> Iterator[None]:
    """Keep the worker busy until the block ends; begins when it has measured something."""
    ended = threading.Event()

    def again() -> None:
        body = {"region": REGION, "subset_px": 21, "spacing_px": 4}
        with httpx.Client(base_url=base, timeout=60.0, trust_env=False) as client:
            while not ended.wait(1.0):
                with contextlib.suppress(httpx.HTTPError):
                    client.post(f"{API}/tests/{TEST_ID}/analyses", json=body)  # beyond the queue's length: 503

    thread = threading.Thread(target=again, daemon=True)
    thread.start()
    try:
        deadline = time.monotonic() + 300.0
        while analysed(data) < 1:
            if time.monotonic() > deadline:
                raise RuntimeError("the worker analysed nothing in five minutes")
            time.sleep(0.1)
        yield
    finally:
        ended.set()
        thread.join()


def watch(load: Load, service: int, began: float, ended: threading.Event) -> None:
    """Note the memory of service and worker twice a second; the worker is the child that holds most."""
    workers = children(service)
    while not ended.wait(0.5):
        with contextlib.suppress(OSError):
            worker = max((resident_mib(pid) for pid in workers), default=0.0)
            load.memory.append((time.monotonic() - began, resident_mib(service), worker))


def verify(data: Path, acknowledged: list[tuple[str, int, dict[str, str]]]) -> list[str]:
    """Return the acknowledged steps whose document or images are not on disk as they were acknowledged."""
    lost = []
    for test, n, sha256 in acknowledged:
        folder = data / "tests" / test / "steps" / f"{n:04d}"
        try:
            same = json.loads((folder / "step.json").read_text())["sha256"] == sha256 and all(
                hashlib.sha256((folder / f"{cam}.tif").read_bytes()).hexdigest() == digest
                for cam, digest in sha256.items()
            )
        except (OSError, ValueError) as error:
            lost.append(f"{test}/{n}: {error}")
        else:
            lost += [] if same else [f"{test}/{n}: other content"]
    return lost


def measure(folder: Path, seconds: float, *, readers: int = READERS) -> Load:
    """Bear the load for so long."""
    load = Load(seconds=seconds)
    with homed_bench(folder, rig_text) as (base, client, controller):
        client.put(f"{API}/sim/scene", json={"scene": "plate"}).raise_for_status()
        with analysing(base, folder / "data"):
            acknowledged = _bear(load, client, controller, seconds, readers, folder / "data")
    load.lost = verify(folder / "data", acknowledged)
    return load


def _bear(
    load: Load, client: httpx.Client, controller: SimESP301, seconds: float, readers: int, data: Path
) -> list[tuple[str, int, dict[str, str]]]:
    service = int((data / "service.lock").read_text().split()[1])
    address = urlsplit(str(client.base_url))
    reading = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.bench.reliability.load_readers",
            address.hostname or "",
            str(address.port),
            str(readers),
            str(READ_EVERY_S),
        ],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    first, began, wall = analysed(data), time.monotonic(), time.time()
    ours = [os.getpid(), reading.pid, service, *children(service)]
    before, (work, whole) = spent_s(ours), busy_s()
    ended = threading.Event()
    watcher = threading.Thread(target=watch, args=(load, service, began, ended))
    watcher.start()
    script = Script(client, controller, load, reading)
    try:
        script.run(began, seconds)
    finally:
        ended.set()
        watcher.join()
        mine, (work, whole) = spent_s(ours) - before, (busy_s()[0] - work, busy_s()[1] - whole)
        load.seconds = time.monotonic() - began
        printed, _ = reading.communicate(timeout=60.0)
    seen: dict[str, Any] = json.loads(printed)
    load.gets = [(at - wall, kind, ms) for at, kind, ms in seen["gets"]]
    load.wrong = seen["wrong"] + [f"{path}: ended" for path in seen["closed"]]
    load.streamed = seen["streamed"]
    load.results = analysed(data) - first
    load.busy_share, load.others_share = work / whole, max(work - mine * _TICK_S, 0.0) / whole
    return script.acknowledged


def lines(load: Load) -> list[str]:
    """Return what a run showed, in words."""
    stops = [ms for _, ms in load.stops]
    captures = [ms for _, ms in load.captures]
    return [
        f"{load.seconds:.0f} s; processors busy {load.busy_share:.0%}, with others' work {load.others_share:.0%}",
        f"captures {len(captures)}, lost {len(load.lost)}, refused and asked again {len(load.refused)}, "
        f"p50 {percentile(captures, 0.5):.0f} ms, p99 {percentile(captures, 0.99):.0f} ms, most {max(captures):.0f} ms",
        f"plain GETs {len(load.gets)}, failed {len(load.wrong)}, p50 {load.latency(0.5):.1f} ms, p99 {load.latency(0.99):.1f} ms, "
        f"most {load.latency(1.0):.1f} ms",
        f"stops {len(stops)}, p50 {percentile(stops, 0.5):.1f} ms, p99 {percentile(stops, 0.99):.1f} ms, most {max(stops):.1f} ms"
        if stops
        else "no stops",
        f"memory of the service {load.memory[-1][1]:.0f} MiB, growth {load.growth_mib(1):+.1f} MiB; "
        f"of the worker {load.memory[-1][2]:.0f} MiB, growth {load.growth_mib(2):+.1f} MiB",
        f"results written meanwhile {load.results}; read from slow streams: "
        + ", ".join(f"{n / 1e6:.1f} MB" for n in load.streamed.values()),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--json", type=Path, help="write everything that was seen to this file")
    parser.add_argument(
        "--page", action="store_true", help="write figures and plot into docs/explanation/reliability.md"
    )
    args = parser.parse_args()
    os.environ["MALLOC_ARENA_MAX"] = "2"  # as the systemd unit gives it to a service that runs for days
    set_priority(-15)  # the controller in here is the instrument: its clock must not wait
    with tempfile.TemporaryDirectory() as folder:
        load = measure(Path(folder), 60.0 * args.minutes)
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(load)))
    print("\n".join(lines(load)))
    if args.page:
        from tests.bench.reliability.load_page import write_page

        write_page(load)
    found = load.faults()
    print("\n".join(f"MISSED: {line}" for line in found) or "every limit held")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
