"""Does the uncertainty cover? Replicates of the whole chain through the command line: ``make coverage``.

Each replicate's sums are appended to a file of its stratum in ``bench_out/coverage``, so that a run that was stopped
goes on where it was; ``--page`` writes the page from what is there; strata that were not drawn here keep the figures of
``figures.json``. Options: ``--replicates N`` of each main stratum (125), ``--others N`` of each other one (30),
``--strata WORD[,WORD]`` those whose names hold a word, ``--threads N``.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tests.bench.coverage.strata import STRATA, Stratum

ROOT = Path(__file__).resolve().parents[3]
OUT = ROOT / "bench_out" / "coverage"
MAIN_REPLICATES, OTHER_REPLICATES = 125, 30
_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def replicate(stratum: Stratum, seed: int) -> dict[str, Any]:
    """Draw, render, calibrate, measure and score one replicate; what went wrong is recorded, too."""
    # kernels take a while to load: not where only the page is written
    from tests.bench.coverage.chain import ChainError, run
    from tests.bench.coverage.draw import drawn
    from tests.bench.coverage.score import scored

    begun = time.process_time()
    one = drawn(stratum, seed)
    with tempfile.TemporaryDirectory(prefix="coverage_") as folder:
        try:
            found = run(one, Path(folder))
        except ChainError as error:
            return {"seed": seed, "refused": str(error), "cpu_s": time.process_time() - begun}
        cells = scored(one, found)
    return {
        "seed": seed,
        "verdict": found.verdict,
        "reasons": found.reasons,
        "warnings": [line for line in found.said.splitlines() if line.startswith(("warning", "failed", "note"))],
        "cells": cells,
        "cpu_s": time.process_time() - begun,
    }


def file_of(stratum: Stratum, folder: Path = OUT) -> Path:
    """The file that a stratum's replicates are kept in."""
    return folder / ("".join(c if c.isalnum() else "_" for c in stratum.name) + ".jsonl")


def kept(stratum: Stratum, folder: Path = OUT) -> list[dict[str, Any]]:
    """The replicates of a stratum that were made so far; a line that a killed run left half is left out."""
    path = file_of(stratum, folder)
    if not path.exists():
        return []
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return list({entry["seed"]: entry for entry in found}.values())


def append(stratum: Stratum, entry: dict[str, Any], folder: Path = OUT) -> None:
    """Keep a replicate."""
    folder.mkdir(parents=True, exist_ok=True)
    path = file_of(stratum, folder)
    half = path.exists() and not path.read_bytes().endswith(b"\n")
    with path.open("a", encoding="utf-8") as file:
        file.write(("\n" if half else "") + json.dumps(entry) + "\n")


def wanted(strata: Sequence[Stratum], main: int, others: int, folder: Path = OUT) -> Iterator[tuple[Stratum, int]]:
    """Replicates that are missing, a round of all strata after the other, so that a short run has some of each."""
    have = {s.name: {entry["seed"] for entry in kept(s, folder)} for s in strata}
    for k in range(max(main, others)):
        for stratum in strata:
            # the others in step with the main ones
            count = main if stratum.main else others
            seeds = range(k * count // max(main, others), (k + 1) * count // max(main, others))
            for seed in seeds:
                if seed not in have[stratum.name]:
                    yield stratum, seed


def _end_with(parent: int) -> None:
    """End this worker when the process that started it does: killed, it tells nobody."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> int:
    """Run what is missing, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=MAIN_REPLICATES)
    parser.add_argument("--others", type=int, default=OTHER_REPLICATES)
    parser.add_argument("--strata", default="")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="write the page from what was kept, and run nothing")
    args = parser.parse_args()
    if not args.page:
        words = [word for word in args.strata.split(",") if word]
        chosen = [s for s in STRATA if not words or any(word in s.name for word in words)]
        for name in _THREAD_SETTINGS:  # a process each: their kernels share nothing
            os.environ[name] = "1"
        todo = list(wanted(chosen, args.replicates, args.others))
        workers = ProcessPoolExecutor(args.threads, get_context("spawn"), _end_with, (os.getpid(),))
        with workers as pool:
            jobs = {pool.submit(replicate, stratum, seed): stratum for stratum, seed in todo}
            for n, job in enumerate(as_completed(jobs), start=1):
                stratum, entry = jobs[job], job.result()
                append(stratum, entry)
                said = entry.get("refused", entry.get("verdict"))
                print(
                    f"{n} of {len(todo)}: {stratum.name}, seed {entry['seed']}: {said}, {entry['cpu_s']:.1f} s",
                    flush=True,
                )
    from tests.bench.coverage.page import write_page

    print(f"written: {write_page()}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
