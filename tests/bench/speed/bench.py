"""Measure speed on this machine, beside a peer and beside the machine's own limits: ``make bench``.

Writes ``docs/explanation/performance.md`` with its plots and prints the same figures; nothing here passes or fails. ``--quick`` takes a few minutes: the
small rig only, no whole measurements. ``--quick`` and ``--only`` (some parts) print and leave the page as it is, unless ``--page`` is given.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from core.threads import available_threads, set_threads
from tests.bench.dense import speed as bench_dense
from tests.bench.speed import assembly
from tests.bench.speed import kernel as bench_kernel
from tests.bench.speed import parts as bench_parts
from tests.bench.speed.ceilings import measure_ceilings
from tests.bench.speed.page import Report, targets, thousands, write_page
from tests.bench.speed.pairs import MODERN, PAPER, BenchScene, make_scene
from tests.bench.speed.peer import Outcome, Run, peer_python, run_ours, run_peer
from tests.bench.speed.sequence_page import measure_all

PARTS = ("ceilings", "code", "kernel", "dense", "peer", "whole")
PEER_SETTINGS: dict[str, dict[str, object]] = {
    "tuned": {"max_displacement": 16},
    "default": {},
    "loose": {"max_displacement": 16, "precision": 0.01},
    "unfiltered": {"max_displacement": 16, "image_filter_kernel": 1},
}
WARM = "warm-up"


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


def dense(report: Report, folder: Path) -> None:
    """A vector every 2 px."""
    del folder
    rates = bench_dense.measure_dense(2 if report.quick else 5)
    text = bench_dense.text(rates)
    report.more.append(("Dense", text))
    report.rows += bench_dense.rows(rates)
    print(text)


def peer(report: Report, folder: Path) -> None:
    """Ours and the peer on the same files."""
    python = peer_python()
    if python is None:
        print("  pyvale is not installed: `make bench` installs it into .venv-bench")
    for request in (PAPER,) if report.quick else (MODERN, PAPER):
        scene = make_scene(request, folder / request.name)
        name = request.name
        report.ours[name], report.peer[name] = [], []
        for threads in counts():
            own, other = _runs(name, threads, report.quick)
            _, found = run_ours(scene, own, threads, folder)
            report.ours[name] += _printed(scene, found)
            if python is not None:
                report.peer_version, found = run_peer(python, scene, other, threads, folder)
                report.peer[name] += _printed(scene, found)
        if python is None:
            del report.peer[name]


def _runs(scene: str, threads: int, quick: bool) -> tuple[list[Run], list[Run]]:
    """What both programs measure; the first run of each only warms the process up."""
    large, all_threads = scene == "modern", threads == counts()[-1]
    steps = 2 if quick else 3 if large and not all_threads else 6
    own, other = [], []
    for subset in (33, 21) if all_threads else (33,):
        for kind in ("cubic", "quintic"):
            options = {"interpolation": kind}
            own.append(Run(f"{kind} single, {subset} px", subset, 1, options, repeats=2))
            own.append(Run(f"{kind} sequence of {steps}, {subset} px", subset, steps, options, repeats=2))
        settings = ["tuned"] if large or not all_threads or subset == 21 or quick else ["tuned", "loose", "unfiltered"]
        for setting in settings:
            if setting == "tuned":
                other.append(Run(f"tuned single, {subset} px", subset, 1, PEER_SETTINGS["tuned"]))
            other.append(Run(f"{setting} sequence of {steps}, {subset} px", subset, steps, PEER_SETTINGS[setting]))
    if large and all_threads:
        other.append(Run("default single, 33 px", 33, 1, PEER_SETTINGS["default"]))
    warm = [Run(f"{WARM} {kind}", 33, 1, {"interpolation": kind}) for kind in ("cubic", "quintic")]
    return [*warm, *own], [Run(WARM, 21, 1, PEER_SETTINGS["tuned"]), *other]


def whole(report: Report, folder: Path) -> None:
    """Whole measurements: sequences, fresh processes, seeds, many points, memory."""
    figures = measure_all(folder, quick=report.quick)
    report.more += figures.sections()
    report.rows += figures.rows()


def _printed(scene: BenchScene, outcomes: list[Outcome]) -> list[Outcome]:
    kept = [o for o in outcomes if not o.run.name.startswith(WARM)]
    for o in kept:
        sd = ", ".join(f"{v:.3f}" for v in o.errors.sd_um)
        print(
            f"  {scene.request.name:8s}{o.run.name:28s}{o.threads:2d} thread(s){o.wall_s:8.2f} s{thousands(o.rate):>10s} / s"
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
