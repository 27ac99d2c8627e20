"""A service at work for an hour: captures, measurement beside them, exports, the page, readers; does anything grow?

Every quarter of a second a step is captured, into tests of 200; an analysis follows each test, or its live measurement where the
service has one. Exports and reports are made of what is finished, three readers ask for documents, one follows the events, and
Chromium goes through the page's screens. Memory, open files and threads of service and worker are noted once a second.

    python -m tests.bench.years.soak [--minutes 60] [--no-page] [--write]
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from scipy.stats import t as student

from tests.bench.page.browser import browser, chromium, fresh_page
from tests.bench.years.measure import API, REGION, make_first, running

EVERY_S = 0.25
STEPS_A_TEST = 200
WARM_S = 600.0
_BLOCKS = 20
_FIXED = bytes(2_000_000)
MACHINE = "a fixed calculation, ms of processor time"
"""A series that shows whether the machine itself became slower meanwhile."""
PROCESSOR = "processor time of {}, ms a second"
"""Series of who works how much: what a service needs more of with its age shows here whatever the machine's speed."""
#: growth after the warm-up that is allowed, over the rest of the run
ALLOWED = {
    "memory of the service, MiB": 16.0,
    "memory of its worker, MiB": 16.0,
    "open files": 3.0,
    "threads": 3.0,
    "a document, ms": 10.0,
    "a capture, ms": 50.0,
}


@dataclass
class Soak:
    """Course of a run: of each series, seconds since its start and values."""

    seconds: float = 0.0
    series: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    live: bool = False
    load: list[float] = field(default_factory=list)

    @property
    def warm_s(self) -> float:
        """Seconds that count as warm-up: ten minutes, of a short run its first half."""
        return min(WARM_S, self.seconds / 2.0)


@dataclass(frozen=True)
class Growth:
    """Growth of a series after the warm-up, with its interval of 95 %."""

    name: str
    mean: float
    grown: float
    low: float
    high: float
    allowed: float

    @property
    def verdict(self) -> str:
        """``flat``, ``grows`` or ``not decided``."""
        if self.low > self.allowed or (self.low > 0 and self.grown > self.allowed):
            return "grows"
        return "flat" if self.high <= self.allowed else "not decided"


def growth(name: str, samples: list[tuple[float, float]], begin_s: float, allowed: float) -> Growth:
    """Fit a straight line to medians of blocks, which are nearly independent; its slope has Student's interval."""
    late = np.array([sample for sample in samples if sample[0] >= begin_s])
    edges = np.linspace(late[0, 0], late[-1, 0] + 1e-6, _BLOCKS + 1)
    at = np.digitize(late[:, 0], edges) - 1
    blocks = [k for k in range(_BLOCKS) if np.any(at == k)]
    x = np.array([late[at == k, 0].mean() for k in blocks])
    y = np.array([np.median(late[at == k, 1]) for k in blocks])
    span = float(late[-1, 0] - late[0, 0])
    a = np.column_stack([np.ones_like(x), x - x.mean()])
    (level, slope), *_ = np.linalg.lstsq(a, y, rcond=None)
    free = len(x) - 2
    sd = float(np.sqrt(np.sum((y - a @ (level, slope)) ** 2) / free / np.sum((x - x.mean()) ** 2)))
    half = float(student.ppf(0.975, free)) * sd * span
    return Growth(
        name, float(level), float(slope) * span, float(slope) * span - half, float(slope) * span + half, allowed
    )


def verdicts(soak: Soak) -> list[Growth]:
    """Return the growth of every series that was noted often enough."""
    return [
        growth(name, soak.series[name], soak.warm_s, allowed)
        for name, allowed in ALLOWED.items()
        if sum(at >= soak.warm_s for at, _ in soak.series.get(name, [])) >= 2 * _BLOCKS
    ]


class Work:
    """The clients of one run, each in a thread of its own."""

    def __init__(self, url: str, soak: Soak, until: float) -> None:
        self.url, self.soak, self._until = url, soak, until
        self.began = time.monotonic()
        self._lock = threading.Lock()
        self.test = ""
        self.analysis = ""

    def going(self) -> bool:
        return time.monotonic() < self._until

    def note(self, name: str, value: float) -> None:
        with self._lock:
            self.soak.series.setdefault(name, []).append((time.monotonic() - self.began, value))

    def count(self, what: str) -> None:
        with self._lock:
            self.soak.done[what] = self.soak.done.get(what, 0) + 1

    def ask(self, client: httpx.Client, method: str, path: str, *, busy: tuple[int, ...] = (), **options: Any) -> Any:
        """Ask; what is answered otherwise than it should be is noted, and None returned."""
        answer = client.request(method, f"{API}{path}", **options)
        if answer.is_success:
            return answer
        if answer.status_code not in busy:
            with self._lock:
                self.soak.wrong.append(f"{method} {path.split('?')[0]}: {answer.status_code} {answer.text[:120]}")
        return None

    def captures(self, client: httpx.Client) -> None:
        """Capture steps to a beat; begin a test and what measures it every two hundredth time."""
        calibration = client.get(f"{API}/calibrations").json()["calibrations"][0]["id"]
        index, due = 0, time.monotonic()
        while self.going():
            if index % STEPS_A_TEST == 0:
                self._new_test(client, calibration, index)
            began = time.monotonic()
            key = {"Idempotency-Key": f"soak-{index}"}
            body = {"label": f"{index}", "load_n": float(index)}
            if self.ask(client, "POST", f"/tests/{self.test}/steps", json=body, headers=key, busy=(409,)):
                self.note("a capture, ms", (time.monotonic() - began) * 1e3)
                self.count("captures")
            if index % STEPS_A_TEST == 1:
                self._begin_measuring(client)
            index += 1
            due = max(due + EVERY_S, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))

    def _new_test(self, client: httpx.Client, calibration: str, index: int) -> None:
        if self.analysis:
            self.ask(client, "POST", f"{self.analysis}:finish", busy=(409,))
        if self.soak.live and self.test:  # one is measured live at a time
            self.ask(client, "POST", f"/tests/{self.test}/live:stop", busy=(404, 409))
        made = self.ask(client, "POST", "/tests", json={"name": f"soak {index}", "calibration_id": calibration})
        self.test = made.json()["id"]

    def _begin_measuring(self, client: httpx.Client) -> None:
        body = {"region": REGION, "subset_px": 21, "spacing_px": 16}
        made = self.ask(client, "POST", f"/tests/{self.test}/analyses", json={**body, "follow": True}, busy=(503,))
        if made is not None:
            self.analysis = f"/tests/{self.test}/analyses/{made.json()['analysis_id']}"
            self.count("analyses")
        live = {"region": REGION, "field": True, "areas": [{"name": "a1", **REGION}]}
        if self.soak.live and self.ask(client, "POST", f"/tests/{self.test}/live", json=live, busy=(409, 503)):
            self.count("live measurements")

    def exports(self, client: httpx.Client) -> None:
        """Export what is finished in every form, in turn, and the report."""
        turn = 0
        while self.going():
            time.sleep(2.0)
            path = self.analysis
            shown = self.ask(client, "GET", path) if path else None
            if shown is None or not shown.json()["steps_finished"]:
                continue
            forms = ["nc", "csv", "vtu", "mat", "report"]
            form = forms[turn % len(forms)]
            turn += 1
            step = shown.json()["steps_finished"][-1]
            if form == "report":
                made = self.ask(client, "GET", f"{path}/report", busy=(409, 422, 503))
            else:
                made = self.ask(client, "GET", f"{path}/export", params={"format": form, "step": step})
            if made is not None:
                self.count("exports")

    def reads(self, client: httpx.Client) -> None:
        """Ask for documents, about ten a second."""
        while self.going():
            paths = {"jobs": "/jobs", "rig": "/rig", "tests": "/tests"}
            if self.test:
                paths |= {"a test": f"/tests/{self.test}", "steps": f"/tests/{self.test}/steps?limit=50"}
            if self.analysis:
                paths["an analysis"] = self.analysis
            for name, path in paths.items():
                began = time.monotonic()
                if self.ask(client, "GET", path):
                    taken_ms = (time.monotonic() - began) * 1e3
                    self.note("a document, ms", taken_ms)
                    self.note(f"document: {name}, ms", taken_ms)
                    self.count("documents")
                time.sleep(0.1)

    def events(self, client: httpx.Client) -> None:
        """Follow the events, and begin to follow anew every half minute."""
        while self.going():
            with contextlib.suppress(httpx.TransportError), client.stream("GET", f"{API}/events") as answer:
                left = time.monotonic() + 30.0
                for _ in answer.iter_lines():
                    if time.monotonic() > min(left, self._until):
                        break
            self.count("event streams")

    def looks(self, _: httpx.Client) -> None:
        """Go through the page's screens."""
        with browser() as made, fresh_page(made) as page:
            page.on("pageerror", lambda error: self.soak.wrong.append(f"page: {error}"))
            while self.going():
                screens = [
                    "#/rig",
                    "#/jobs",
                    f"#/test/{self.test}",
                    f"#/results/{self.analysis[7:].replace('/analyses', '')}",
                ]
                for screen in screens[: 4 if self.analysis else 3]:
                    page.goto(f"{self.url}/{screen}")
                    page.wait_for_timeout(4000)
                    self.count("screens")
                    if not self.going():
                        break

    def watch(self, process: psutil.Process) -> None:
        """Note what service and worker hold, once a second; the worker is the child that holds most."""
        used = _Used(process)
        while self.going():
            with contextlib.suppress(psutil.Error):
                for name, ms_a_s in used.since_last():
                    self.note(PROCESSOR.format(name), ms_a_s)
                self.note("memory of the service, MiB", process.memory_info().rss / 2**20)
                children = process.children(recursive=True)
                self.note("memory of its worker, MiB", max((c.memory_info().rss for c in children), default=0) / 2**20)
                self.note("open files", process.num_fds())
                self.note("threads", process.num_threads())
                began = time.thread_time()
                hashlib.sha256(_FIXED).digest()
                self.note(MACHINE, (time.thread_time() - began) * 1e3)
                self.soak.load.append(os.getloadavg()[0])
            time.sleep(1.0)


class _Used:
    """Processor time of the service, of its children, and of this program with its browser, since the last look."""

    def __init__(self, service: psutil.Process) -> None:
        self._service, self._own = service, psutil.Process()
        self._at, self._last = time.monotonic(), self._now()

    def _now(self) -> dict[psutil.Process, tuple[str, float]]:
        children = self._service.children(recursive=True)
        others = [p for p in self._own.children(recursive=True) if p not in children and p != self._service]
        groups = {"the service": [self._service], "its children": children, "clients and browser": [self._own, *others]}
        found = {}
        for name, processes in groups.items():
            for process in processes:
                with contextlib.suppress(psutil.Error):
                    times = process.cpu_times()
                    found[process] = (name, times.user + times.system)
        return found

    def since_last(self) -> list[tuple[str, float]]:
        """Return milliseconds a second for each group; a process that ended meanwhile is not counted."""
        at, now = time.monotonic(), self._now()
        sums: dict[str, float] = {}
        for process, (name, used_s) in now.items():
            before_s = self._last.get(process, (name, 0.0))[1]
            sums[name] = sums.get(name, 0.0) + 1e3 * (used_s - before_s)
        apart, self._at, self._last = max(at - self._at, 1e-3), at, now
        return [(name, ms / apart) for name, ms in sums.items()]


@contextlib.contextmanager
def _beside(work: Work, tasks: list[Callable[[httpx.Client], None]]) -> Iterator[None]:
    def run(task: Callable[[httpx.Client], None]) -> None:
        try:
            with httpx.Client(base_url=work.url, timeout=120.0, trust_env=False) as client:
                task(client)
        except Exception as error:  # noqa: BLE001 - the run goes on, and says what did not
            if work.going():
                work.soak.wrong.append(f"{task.__name__} ended: {error!r}")

    threads = [threading.Thread(target=run, args=(task,), name=task.__name__, daemon=True) for task in tasks]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        for thread in threads:
            thread.join(timeout=150.0)


def _failed(client: httpx.Client) -> list[str]:
    """Return the jobs that failed."""
    found: list[str] = []
    cursor: str | None = ""
    while cursor is not None:
        page = client.get(f"{API}/jobs", params={"limit": 100, **({"cursor": cursor} if cursor else {})}).json()
        found += [f"{job['kind']} {job['id']}: {job['problem']}" for job in page["jobs"] if job["state"] == "failed"]
        cursor = page["next_cursor"]
    return found


def run(folder: Path, seconds: float, *, page: bool = True) -> Soak:
    """Let a service work for so long."""
    soak = Soak(seconds=seconds)
    make_first(folder / "data")
    with running(folder) as (process, client, _):
        while client.get("/readyz").status_code != 200:
            time.sleep(0.2)
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()
        soak.live = "/api/v1/tests/{test_id}/live" in client.get(f"{API}/openapi.json").json()["paths"]
        work = Work(str(client.base_url).rstrip("/"), soak, time.monotonic() + seconds)
        tasks = [work.captures, work.exports, work.reads, work.events]
        if page and chromium() is not None:
            tasks.append(work.looks)
        with _beside(work, tasks):
            work.watch(process)
        soak.wrong += _failed(client)
    return soak


def lines(soak: Soak) -> list[str]:
    """Return what a run showed, in words."""
    return [
        f"{soak.seconds / 60:.1f} min, load {np.mean(soak.load):.1f}; "
        + ", ".join(f"{n} {what}" for what, n in soak.done.items()),
        *(
            f"{g.name}: {g.mean:.1f}, growth {g.grown:+.2f} ({g.low:+.2f} to {g.high:+.2f}), {g.verdict}"
            for g in verdicts(soak)
        ),
        *soak.wrong[:10],
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--no-page", action="store_true", help="without Chromium")
    parser.add_argument("--json", type=Path, help="write everything that was seen to this file")
    parser.add_argument("--write", action="store_true", help="write figures and plot into docs/explanation/years.md")
    args = parser.parse_args()
    os.environ["MALLOC_ARENA_MAX"] = "2"  # as the systemd unit gives it to a service that runs for days
    with tempfile.TemporaryDirectory() as folder:
        soak = run(Path(folder), 60.0 * args.minutes, page=not args.no_page)
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(soak)))
    print("\n".join(lines(soak)))
    if args.write:
        from tests.bench.years.page import write_soak

        write_soak(soak)
    sys.exit(bool(soak.wrong) or any(one.verdict == "grows" for one in verdicts(soak)))


if __name__ == "__main__":
    main()
