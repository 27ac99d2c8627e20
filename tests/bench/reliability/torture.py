"""Kills the service a thousand times while it works, and checks each time whether anything was lost.

Each kill is a SIGKILL at a random instant, while the service captures, imports, calibrates, measures noise, analyses,
deletes or starts. After each the same data folder is served again, and everything that was ever acknowledged is compared
with what is there (tests/bench/reliability/torture_lab.py). Most services are forked from a process that has loaded the modules
already; one in twenty-five is started from the shell, and its time from there to `/readyz` is measured.

    python -m tests.bench.reliability.torture [--kills 1000] [--seed N] [--json FILE] [--write]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from stereorig.server.formats.version import software_version
from tests.bench.reliability.torture_lab import RIG, Lab, Pictures
from tests.support.patience import Deadline
from tests.support.requirements import ROOT

KILLS_IN_A_FOLDER = 25
COLD_EVERY = 25
_WAIT_S = 120.0
#: as on a machine that has nothing else to do; processors are shared out by session first, so both are needed
FIRST = ("sh", "-c", 'echo -20 > /proc/self/autogroup; exec nice -n -20 "$@"', "sh")
#: what goes on when the kill comes: how often out of a hundred, and the longest that it goes on in s
ACTS: dict[str, tuple[int, float]] = {
    "record": (42, 0.5),
    "analyse": (20, 0.1),
    "calibrate": (16, 0.1),
    "delete": (10, 0.4),
    "noise": (6, 0.1),
    "start": (6, 0.5),
}
JOBS = ("analyse", "calibrate", "noise")
MAX_JOB_S = 30.0


@dataclass
class Running:
    """A service that was started."""

    pid: int
    began: float
    out: Path
    err: Path
    process: subprocess.Popen[bytes] | None = None

    def url(self) -> str:
        """Wait until it prints where it serves."""
        deadline = Deadline(_WAIT_S)
        while deadline.left:
            line = self.out.read_text() if self.out.exists() else ""
            if line.endswith("\n"):
                return next(word for word in line.split() if word.startswith("http://"))
            if not is_there(self.pid):
                break
            time.sleep(0.005)
        raise RuntimeError(f"the service did not start:\n{self.err.read_text()[-3000:]}")

    def end(self, number: signal.Signals) -> list[int]:
        """Send a signal and wait until the process is gone; return the processes of its own that were there."""
        children = children_of(self.pid)
        os.kill(self.pid, number)
        deadline = Deadline(_WAIT_S)
        if self.process is not None:
            self.process.wait(4 * _WAIT_S)
        while is_there(self.pid) and deadline.left:
            time.sleep(0.002)
        return children


@dataclass
class Starter:
    """Starts services: forked from one process that has loaded everything, or from the shell."""

    folder: Path
    first: bool = False  # let those from the shell come before everything else on the machine
    cold_every: int = COLD_EVERY  # one of so many is started from the shell
    made: int = 0
    zygote: subprocess.Popen[bytes] = field(init=False)

    def __post_init__(self) -> None:
        (self.folder / "rig.toml").write_text(RIG)
        self.zygote = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.reliability.torture_zygote"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.zygote.stdout is not None
        line = self.zygote.stdout.readline()
        if not line:
            raise RuntimeError("the process that forks services ended")
        return dict(json.loads(line))

    def start(self, data: Path, *, cold: bool) -> Running:
        """Start a service on a data folder."""
        self.made += 1
        out, err = (self.folder / f"{self.made}.{name}" for name in ("out", "err"))
        argv = ["serve", "--config", str(self.folder / "rig.toml"), "--port", "0", "--data", str(data)]
        began = time.monotonic()
        if cold:
            with out.open("wb") as stdout, err.open("wb") as stderr:
                process = subprocess.Popen(
                    [*(FIRST if self.first else ()), sys.executable, "-m", "stereorig.server.cli", *argv],
                    cwd=ROOT,
                    stdout=stdout,
                    stderr=stderr,
                    start_new_session=True,
                )
            return Running(process.pid, began, out, err, process)
        assert self.zygote.stdin is not None
        self.zygote.stdin.write(json.dumps({"argv": argv, "out": str(out), "err": str(err)}).encode() + b"\n")
        self.zygote.stdin.flush()
        return Running(int(self._answer()["pid"]), began, out, err)

    def close(self) -> None:
        """End the process that forks."""
        assert self.zygote.stdin is not None
        self.zygote.stdin.close()
        self.zygote.wait(60.0)
        if self.zygote.stdout is not None:
            self.zygote.stdout.close()


def is_there(pid: int) -> bool:
    """Whether a process runs."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children_of(pid: int) -> list[int]:
    """Processes whose parent it is."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(path.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def cpu_s(pid: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Outcome:
    """What a thousand kills came to."""

    kills: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    forked: list[dict[str, float]] = field(default_factory=list)
    cold: list[dict[str, float]] = field(default_factory=list)
    left_s: list[float] = field(default_factory=list)
    wall_s: float = 0.0

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "kills": sum(self.kills.values()),
            "by_act": dict(self.kills),
            "counts": dict(self.counts),
            "wrong": self.wrong,
            "forked": self.forked,
            "cold": self.cold,
            "left_s": self.left_s,
            "wall_s": round(self.wall_s, 1),
            "machine": machine(),
            "version": software_version(),
        }


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    model = next(
        (
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        "",
    )
    return {
        "processors": len(os.sched_getaffinity(0)),
        "model": model,
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 1),
    }


def bring_up(running: Running, outcome: Outcome, *, cold: bool, first: bool = False) -> str:
    """Wait until a service is ready; note how long that took."""
    url = running.url()
    times = {"answers_s": time.monotonic() - running.began}
    with httpx.Client(base_url=url, timeout=30.0, trust_env=False, verify=False) as client:
        deadline = Deadline(_WAIT_S)
        while (answer := client.get("/readyz")).status_code != 200:
            reasons = {reason["code"] for reason in answer.json()["reasons"]}
            if "captures_s" not in times and reasons <= {"worker_starting"}:
                times["captures_s"] = time.monotonic() - running.began
            if deadline.is_over:
                raise RuntimeError(f"the service is not ready: {answer.text}\n{running.err.read_text()[-3000:]}")
            time.sleep(0.02)
    times["ready_s"] = time.monotonic() - running.began
    times.setdefault("captures_s", times["ready_s"])
    if cold:
        times["first"] = float(first)
        times["service_cpu_s"] = cpu_s(running.pid)
        times["worker_cpu_s"] = max((cpu_s(pid) for pid in children_of(running.pid)), default=0.0)
    (outcome.cold if cold else outcome.forked).append({name: round(value, 3) for name, value in times.items()})
    return url


def torture_folder(starter: Starter, lab: Lab, outcome: Outcome, kills: int, rng: random.Random) -> None:
    """Kill ``kills`` services on one folder, then check a last time and end in order."""
    names, weights = list(ACTS), [share for share, _ in ACTS.values()]
    for k in range(kills + 1):
        act = rng.choices(names, weights)[0]
        cold = (outcome_starts(outcome) + 1) % starter.cold_every == 0
        running = starter.start(lab.data, cold=cold)
        if act == "start" and k < kills:
            time.sleep(rng.uniform(0.0, ACTS[act][1] * (10.0 if cold else 1.0)))
            _kill(running, act, outcome)
            continue
        url = bring_up(running, outcome, cold=cold, first=starter.first)
        with httpx.Client(base_url=f"{url}/api/v1", timeout=60.0, trust_env=False, verify=False) as client:
            lab.check(client)
            lab.new_capture(client)
        if k == kills:
            running.end(signal.SIGTERM)
            break
        threads = lab.begin(act, url)
        if act in JOBS:  # by how far the job is, and not by the clock: on a busy machine none would ever get far
            goal, deadline = rng.uniform(0.0, 1.1), Deadline(MAX_JOB_S)
            while lab.progress < min(goal, 1.0) and deadline.left:
                time.sleep(0.002)
        time.sleep(rng.uniform(0.0, ACTS[act][1]))
        lab.killed.set()  # what fails from now on fails for that
        _kill(running, act, outcome)
        lab.over.set()
        for thread in threads:
            thread.join(60.0)
    outcome.counts.update(lab.counts)
    outcome.wrong += [f"{lab.data.name} (seed {lab.seed}): {line}" for line in lab.wrong]


def outcome_starts(outcome: Outcome) -> int:
    """Services brought up so far."""
    return len(outcome.cold) + len(outcome.forked)


def _kill(running: Running, act: str, outcome: Outcome) -> None:
    children = running.end(signal.SIGKILL)
    dead, deadline = time.monotonic(), Deadline(10.0)
    while any(is_there(pid) for pid in children):
        if deadline.is_over:
            outcome.wrong.append(f"a process of a killed service is still there after 10 s ({act})")
            break
        time.sleep(0.002)
    outcome.left_s.append(round(time.monotonic() - dead, 3))
    outcome.kills[act] += 1


def torture(
    folder: Path,
    kills: int,
    seed: int,
    *,
    first: bool = False,
    cold_every: int = COLD_EVERY,
    tell: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Kill and check, in data folders of ``KILLS_IN_A_FOLDER`` kills each; stops at the first folder with a loss.

    Parameters
    ----------
    first
        Let the starts from the shell come before everything else on the machine (needs root).
    cold_every
        One start of so many is from the shell.
    """
    outcome, pictures = Outcome(), Pictures()
    began = time.monotonic()
    starter = Starter(folder, first=first, cold_every=cold_every)
    try:
        for number in range(-(-kills // KILLS_IN_A_FOLDER)):
            lab = Lab(folder / f"data{number}", pictures, seed + number)
            here = min(KILLS_IN_A_FOLDER, kills - sum(outcome.kills.values()))
            torture_folder(starter, lab, outcome, here, random.Random(seed + number))
            done = sum(outcome.kills.values())
            tell(f"{done} kills, {len(outcome.wrong)} wrong, {time.monotonic() - began:.0f} s")
            if outcome.wrong:
                break
            shutil.rmtree(lab.data)  # what was lost is kept
    finally:
        starter.close()
        outcome.wall_s = time.monotonic() - began
    return outcome


def summary(outcome: Outcome) -> str:
    """Write it in a few lines."""
    lines = [
        f"{sum(outcome.kills.values())} kills ({', '.join(f'{n} {act}' for act, n in outcome.kills.most_common())}) in {outcome.wall_s:.0f} s"
    ]
    lines += [f"  {name}: {n}" for name, n in sorted(outcome.counts.items()) if n]
    for name, starts in (("from the shell", outcome.cold), ("forked", outcome.forked)):
        if starts:
            times = sorted(start["ready_s"] for start in starts)
            lines.append(
                f"  restart to ready, {name}: median {statistics.median(times):.2f} s, slowest {times[-1]:.2f} s of {len(times)}"
            )
    lines += [f"WRONG: {line}" for line in outcome.wrong] or ["nothing lost, nothing wrong"]
    return "\n".join(lines)


def main() -> int:
    """Torture and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=None, help="to repeat a run (default: another one each time)")
    parser.add_argument("--usual", action="store_true", help="give starts from the shell no priority, as root too")
    parser.add_argument("--cold-every", type=int, default=COLD_EVERY, help="one start of so many is from the shell")
    parser.add_argument("--json", type=Path, help="write all figures there")
    parser.add_argument(
        "--write", action="store_true", help="write docs/explanation/reliability.md's section and figure"
    )
    parser.add_argument("--page", type=Path, nargs="+", metavar="FILE", help="write them from runs' JSON, kill nothing")
    args = parser.parse_args()
    if args.page is not None:
        from tests.bench.reliability.torture_page import joined, write_page

        write_page(joined([json.loads(path.read_text()) for path in args.page]))
        return 0
    seed = random.SystemRandom().randrange(10**6) if args.seed is None else args.seed
    print(f"seed {seed}", flush=True)
    folder = Path(tempfile.mkdtemp(prefix="torture-"))
    first = os.geteuid() == 0 and not args.usual
    outcome = torture(
        folder, args.kills, seed, first=first, cold_every=args.cold_every, tell=lambda line: print(line, flush=True)
    )
    print(summary(outcome))
    if args.json is not None:
        args.json.write_text(json.dumps(outcome.document()))
    if outcome.wrong:
        print(f"everything is kept in {folder}")
        return 1
    shutil.rmtree(folder)
    if args.write:
        from tests.bench.reliability.torture_page import write_page

        write_page(outcome.document())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
