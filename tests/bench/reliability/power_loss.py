"""Opens every state in which a lost power may leave the data folder, and writes what was found.

Days of work are recorded on the service itself, each in another order (tests/support/power_loss). At every instant of a
day, the states are made that a file system may hold then, and the service starts on each. The instants of a day are
taken in passes that each go through the whole day, so that a run that is ended by the clock has seen all of its parts.

    python -m tests.bench.reliability.power_loss [--states 100000] [--minutes N] [--seed N] [--processes N] [--write | --add]
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from tests.bench.documents.prose import wrapped
from tests.bench.reliability.torture_lab import Pictures
from tests.bench.reliability.torture_page import PAGE, table
from tests.support.power_loss.check import CATALOGS, State, Verdict, crash_states, look_at_all
from tests.support.power_loss.recording import Recording, record

BEGIN, END = "<!-- power loss: begin -->", "<!-- power loss: end -->"
_MEMORY = Path("/dev/shm")  # states are made and removed by the ten thousand
_OF_AN_INSTANT = 200
_PASSES = 32
_DAYS_APART = 1000  # seeds of one process's days from the next one's


def _states(recording: Recording, seed: int, ends: float) -> Iterator[State]:
    """Yield the states of a day pass by pass, until the clock says so."""
    offsets = random.Random(seed).sample(range(_PASSES), _PASSES)
    for offset in offsets:
        for state in crash_states(recording, random.Random(seed), _OF_AN_INSTANT, _PASSES, offset):
            if time.monotonic() > ends:
                return
            yield state


def run(states: int, seed: int, folder: Path, minutes: float = float("inf")) -> tuple[Verdict, Counter[str]]:
    """Record days, and look at the states of each, until so many were seen or the time is over.

    Returns
    -------
    tuple
        What was found; the number of days, changes and acknowledged requests.
    """
    total, size, pictures = Verdict(), Counter[str](), Pictures(4)
    ends = time.monotonic() + 60.0 * minutes
    while total.states < states and time.monotonic() < ends:
        day = size["days"]
        top = folder / f"day{day}"
        top.mkdir(parents=True)
        recording = record(top, pictures, seed + day)
        found = look_at_all(recording, folder / f"states{day}", _states(recording, seed + day, ends), print)
        total = Verdict(total.states + found.states, total.wrong + found.wrong, total.counts + found.counts)
        size.update({"days": 1, "changes": len(recording.journal.changes), "requests": len(recording.answers)})
        print(f"day {day + 1}: {found.states} states, {len(found.wrong)} things wrong", flush=True)
        for done in (top, folder / f"states{day}"):
            shutil.rmtree(done)
    return total, size


def run_side_by_side(
    processes: int, states: int, seed: int, folder: Path, minutes: float
) -> tuple[Verdict, Counter[str]]:
    """Do as :func:`run` in several processes, each with days of its own."""
    share = -(-states // processes)
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        jobs = [
            pool.submit(run, share, seed + _DAYS_APART * k, folder / f"process{k}", minutes) for k in range(processes)
        ]
        found = [job.result() for job in jobs]
    total, size = Verdict(), Counter[str]()
    for verdict, of in found:
        total = Verdict(total.states + verdict.states, total.wrong + verdict.wrong, total.counts + verdict.counts)
        size.update(of)
    return total, size


def section(found: Verdict, size: Counter[str], wall_s: float) -> str:
    """Write the section of the page."""
    text = (
        f"{found.states:,} states of {size['days']} recorded {'day' if size['days'] == 1 else 'days'} ({size['requests']:,} acknowledged requests, "
        f"{size['changes']:,} changes of the data folder): {len(found.wrong)} in which something acknowledged was lost, "
        f"something half was shown, or `stereorig verify` disagreed. {wall_s / 60:.0f} minutes."
    )
    return "\n".join(
        [wrapped(text), "", table(["states", "catalogue"], [[f"{found.counts[name]:,}", name] for name in CATALOGS])]
    )


def write(text: str, *, add: bool) -> None:
    """Put a section into the page, in place of what is there or before it."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    old, _, after = rest.partition(END)
    whole = f"{text}\n\nA run before:\n\n{old.strip()}" if add else text
    PAGE.write_text(f"{before}{BEGIN}\n{whole}\n{END}{after}", encoding="utf-8")


def main() -> int:
    """Run, and write the section if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=100_000, help="at least so many (100000)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end after so many, wherever it is then")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1, help="so many side by side, each with days of its own")
    parser.add_argument("--write", action="store_true", help="write the section of docs/explanation/reliability.md")
    parser.add_argument("--add", action="store_true", help="write it before what the section holds")
    asked = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="power-loss-", dir=_MEMORY if _MEMORY.is_dir() else None) as folder:
        if asked.processes == 1:
            found, size = run(asked.states, asked.seed, Path(folder), asked.minutes)
        else:
            found, size = run_side_by_side(asked.processes, asked.states, asked.seed, Path(folder), asked.minutes)
    text = section(found, size, time.monotonic() - began)
    print(text)
    if asked.write or asked.add:
        write(text, add=asked.add)
    return bool(found.wrong)


if __name__ == "__main__":
    sys.exit(main())
