"""Measure speed on this machine, beside peers and beside the machine's own limits: ``make bench``.

Writes ``docs/explanation/performance.md`` with its plots and prints the same figures; nothing here passes or fails. ``--quick`` takes a few minutes: the
small rig only, no whole measurements. ``--quick`` and ``--only`` (some parts) print and leave the page as it is, unless ``--page`` is given.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
import time
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from stereorig.core.threads import available_threads, set_threads
from tests.bench.dense import speed as bench_dense
from tests.bench.speed import assembly
from tests.bench.speed import kernel as bench_kernel
from tests.bench.speed import parts as bench_parts
from tests.bench.speed.ceilings import measure_ceilings
from tests.bench.speed.ending import HOW as ENDING_HOW
from tests.bench.speed.ending import measure_ending
from tests.bench.speed.layout import of_threads, thousands
from tests.bench.speed.page import Report, targets, write_page
from tests.bench.speed.pairs import MODERN, PAPER, BenchScene, make_scene
from tests.bench.speed.peers.plan import WARM, own_runs, peer_runs
from tests.bench.speed.peers.programs import PEERS
from tests.bench.speed.peers.runs import Beside, Outcome, run_ours, run_peer
from tests.bench.speed.sequence_page import measure_all

PARTS = ("ceilings", "code", "kernel", "dense", "peer", "whole")


def counts() -> list[int]:
    """Numbers of threads to measure at."""
    return sorted({1, min(2, available_threads())})


def ceilings(report: Report, folder: Path) -> None:
    """What the machine can do."""
    del folder
    for threads in counts():
        report.ceilings.append(measure_ceilings(threads))
        print(f"  {report.ceilings[-1]}")


def code(report: Report, folder: Path) -> None:
    """What the compiler makes of the loops."""
    del folder
    names = [assembly.HERE] if report.quick else [assembly.HERE, *assembly.TARGETS]
    for name in names:
        found = assembly.inspect_target(name)
        report.loops += found
        for loop in found:
            print(f"  {loop.target:16s}{loop.loop:22s}{loop.width_bits:4d} bit  {loop.counts}  stack {loop.stack}")


def kernel(report: Report, folder: Path) -> None:
    """The matcher at a point."""
    del folder
    runs = 3 if report.quick else 7
    scene = bench_kernel.make_kernel_scene(8 if report.quick else 4)
    for threads in counts():
        rates, report.iterations = bench_kernel.measure_rates(scene, threads, runs)
        report.rates += rates
        for r in rates:
            print(
                f"  {r.fit:8s}{r.interpolation:9s}{r.subset_px:3d} px {r.threads:2d} thread(s){thousands(r.per_second):>10s} / s"
            )
    for kind in bench_kernel.KINDS:
        report.costs.append(bench_kernel.measure_costs(scene, kind, runs, 500 if report.quick else 1500))
        c = report.costs[-1]
        print(f"  {kind}: {c.loop_ns:.2f} ns a pixel, image and iteration; {c.overhead_us(2.0):.2f} us a point besides")
        for subset in (21, 33):
            report.parts.append(bench_parts.measure_parts(scene, kind, subset))
            print(f"  {report.parts[-1]}")
    set_threads(available_threads())
    repeats = 5 if report.quick else 20
    endings = [measure_ending("cubic", subset, repeats) for subset in (33, 21)]
    report.rows += [row for ending in endings for row in ending.rows()]
    report.more.append(("Where a fit ends", ENDING_HOW.format(repeats=repeats)))
    for ending in endings:
        print(f"  {ending}")


def dense(report: Report, folder: Path) -> None:
    """A vector every 2 px."""
    del folder
    rates = bench_dense.measure_dense(2 if report.quick else 5)
    text = bench_dense.text(rates)
    report.more.append(("Dense", text))
    report.rows += bench_dense.rows(rates)
    print(text)


def peer(report: Report, folder: Path) -> None:
    """Ours and the peers on the same files."""
    pythons = {p.name: p.interpreter() for p in PEERS}
    for p in PEERS:
        if pythons[p.name] is None:
            print(f"  {p.how_to_install}")
    report.peers = [Beside(p) for p in PEERS if pythons[p.name] is not None]
    for request in (PAPER,) if report.quick else (MODERN, PAPER):
        scene = make_scene(request, folder / request.name)
        name = request.name
        report.ours[name] = []
        for threads in counts():
            all_threads = threads == counts()[-1]
            runs = own_runs(name, all_threads=all_threads, quick=report.quick)
            report.ours[name] += _printed("stereorig", scene, run_ours(scene, runs, threads, folder)[1])
            for beside in report.peers:
                runs = peer_runs(beside.peer, name, all_threads=all_threads, quick=report.quick)
                python = pythons[beside.peer.name]
                assert python is not None
                try:
                    beside.version, found = run_peer(beside.peer, python, scene, runs, threads, folder)
                except (RuntimeError, ValueError, subprocess.TimeoutExpired) as error:  # the rest is worth an hour
                    print(f"  {beside.peer.name} failed: {error}", flush=True)
                    beside.failed.append(f"{name}, {of_threads(threads)}")
                else:
                    beside.outcomes.setdefault(name, []).extend(_printed(beside.peer.name, scene, found))


def whole(report: Report, folder: Path) -> None:
    """Whole measurements: sequences, fresh processes, seeds, many points, memory."""
    figures = measure_all(folder, quick=report.quick)
    report.more += figures.sections()
    report.rows += figures.rows()


def _printed(program: str, scene: BenchScene, outcomes: list[Outcome]) -> list[Outcome]:
    kept = [o for o in outcomes if not o.run.name.startswith(WARM)]
    for o in kept:
        sd = ", ".join(f"{v:.3f}" for v in o.errors.sd_um)
        print(
            f"  {scene.request.name:8s}{program:11s}{o.run.name:32s}{o.threads:2d} thread(s){o.wall_s:8.2f} s{thousands(o.rate):>10s} / s"
            f"   lost {o.errors.lost}   sd of u, v, w, Z {sd} um",
            flush=True,
        )
    return kept


def main() -> int:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a minute: the small rig only; the page is not written")
    parser.add_argument("--only", default="", help=f"some of {', '.join(PARTS)}; the page is not written")
    parser.add_argument("--page", action="store_true", help="write the page all the same, without the parts left out")
    args = parser.parse_args()
    wanted = [name for name in args.only.split(",") if name] or list(PARTS[:-1] if args.quick else PARTS)
    report = Report(quick=args.quick)
    jobs = {"ceilings": ceilings, "code": code, "kernel": kernel, "dense": dense, "peer": peer, "whole": whole}
    with tempfile.TemporaryDirectory(prefix="stereorig_bench_") as folder:
        for name in wanted:
            start = time.perf_counter()
            print(name, flush=True)
            jobs[name](report, Path(folder))
            print(f"  ({time.perf_counter() - start:.0f} s)", flush=True)
    print("\n" + "\n".join(row.text() for row in targets(report)))
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    print(f"\nload of the machine at the end: {load:.1f}")
    if args.page or not (args.only or args.quick):
        print(f"wrote {write_page(report)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
