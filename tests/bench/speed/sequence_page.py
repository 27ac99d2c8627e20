"""What ``bench_sequence`` measured, as rows, sections and plots of ``docs/explanation/performance.md``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from stereorig.core.threads import available_threads
from tests.bench.accuracy.table import Row
from tests.bench.speed import sequence as bench
from tests.bench.speed.layout import of_threads, save, table, thousands
from tests.bench.speed.sequence import PointCost, SeedFigures, SequenceFigures, Used

PARTS = ("sequence", "fresh", "seeds", "points", "memory")
RATE, FIRST_S, STEP_S, SEEDS_S, COMPILE_S, LARGE_MB, COST = 60_000.0, 3.0, 1.5, 1.0, 10.0, 1500.0, 1.25


@dataclass
class Figures:
    """Everything about whole measurements."""

    sequences: list[SequenceFigures] = field(default_factory=list)
    shape: Used | None = None
    displacement: Used | None = None
    cold: dict[str, tuple[Used, Used]] = field(default_factory=dict)
    seeds: list[SeedFigures] = field(default_factory=list)
    points: list[PointCost] = field(default_factory=list)
    large: dict[int, Used] = field(default_factory=dict)
    memory: dict[int, Used] = field(default_factory=dict)

    def rows(self) -> list[Row]:
        """Figures with their targets."""
        out = []
        max_threads = available_threads()
        for s in self.sequences:
            limit = RATE if (s.threads, s.suffix, s.interpolation) == (max_threads, "tif", "cubic") else None
            what = f"sequence, disk to disk, {s.interpolation}, {s.suffix}, {of_threads(s.threads)}"
            out.append(Row(what, s.rate, "points/s", limit, at_least=True))
        if self.shape is not None:
            out.append(Row("first field of a fresh process: shape", self.shape.wall_s, "s", FIRST_S))
        if self.displacement is not None:
            out.append(Row("the same and a first displacement", self.displacement.wall_s, "s", STEP_S))
        for kind, (cold, warm) in self.cold.items():
            what = f"compiling everything a first {kind} measurement needs"
            out.append(Row(what, cold.wall_s - warm.wall_s, "s", COMPILE_S))
            out.append(Row(f"{what}, processor time of both processes", cold.cpu_s - warm.cpu_s, "s"))
        for f in self.seeds:
            what = f"feature seeds on 2448 x 2048 px, {f.what}, {of_threads(f.threads)}"
            out.append(Row(what, f.wall_s, "s", SEEDS_S if f.what == "shape" and f.threads == max_threads else None))
        if len(self.points) > 1:
            few, many = self.points[-2], self.points[-1]
            ratio = (many.later_s / many.points) / (few.later_s / few.points)
            out.append(
                Row(f"cost of a point, {thousands(many.points)} over {thousands(few.points)} points", ratio, "", COST)
            )
        for steps, used in self.large.items():
            what = "24 megapixels, 250,000 points: peak memory, " + ("a pair" if steps == 0 else f"and {steps} step")
            out.append(Row(what, used.peak_mb, "MB", LARGE_MB if steps == 0 else None))
        if len(self.memory) > 1:
            few_steps, many_steps = min(self.memory), max(self.memory)
            more = self.memory[many_steps].peak_mb - self.memory[few_steps].peak_mb
            out.append(Row(f"peak memory of {many_steps} steps over that of {few_steps}", more, "MB", 20.0))
        return out

    def sections(self) -> list[tuple[str, str]]:
        """Titles and texts for the page; draws the plots."""
        out = []
        if self.sequences:
            out.append(("A sequence, disk to disk", self._sequence_text()))
        if self.shape is not None and self.displacement is not None:
            out.append(("A fresh process", self._fresh_text()))
        if self.seeds:
            out.append(("Seeds", self._seeds_text()))
        if self.points:
            out.append(("Cost against points", self._points_text()))
        if self.memory or self.large:
            out.append(("Memory", self._memory_text()))
        return out

    def _sequence_text(self) -> str:
        head = ["threads", "images", "spline", "points/s", "ms a step", *(stage for stage, _, _ in bench.STAGES)]
        rows = [
            [
                str(s.threads),
                s.suffix,
                s.interpolation,
                thousands(s.rate),
                f"{1e3 * s.step_s:.0f}",
                *(f"{s.stages[stage][0]:.0f}" for stage, _, _ in bench.STAGES),
            ]
            for s in self.sequences
        ]
        valid = min(s.valid for s in self.sequences)
        return "\n\n".join(
            [
                f"{SIZE} px, {thousands(bench.POINTS)} points, {bench.SUBSET_PX} px subsets, stretch patches, gates on, strain of 9 points, a "
                f"calibration with its covariance (common factor, budgets, systematic terms), one NetCDF file a step, synced; "
                f"{self.sequences[0].steps} steps after the reference, some 0.7 px of motion a step. The rate counts the steps after the first field, from its "
                f"file to the last one's; {100 * valid:.2f} % of the points valid. Stages are wall milliseconds a step. "
                f"{', '.join(bench.BESIDE)} run on threads of their own while the next or last step is fitted; the rest of a step is its share of "
                f"growth, checks of single points and Python.",
                table(head, rows),
                self._sequence_plot(),
            ]
        )

    def _sequence_plot(self) -> str:
        figure, ax = plt.subplots(figsize=(9, 0.9 + 0.5 * len(self.sequences)), layout="constrained")
        names = [f"{s.interpolation}, {s.suffix}, {of_threads(s.threads)}" for s in self.sequences]
        left = [0.0] * len(names)
        for k, (stage, _, _) in enumerate(bench.STAGES):
            width = [s.stages[stage][0] for s in self.sequences]
            hatch = "//" if stage in bench.BESIDE else None
            ax.barh(names, width, left=left, label=stage, hatch=hatch, color=f"C{k}", edgecolor="white")
            left = [a + b for a, b in zip(left, width, strict=True)]
        ax.plot([1e3 * s.step_s for s in self.sequences], names, "k|", markersize=18, label="a step")
        ax.axvline(1e3 * bench.POINTS / RATE, color="grey", linestyle=":", label="target")
        ax.invert_yaxis()
        ax.set(xlabel="ms a step; hatched: beside the fits")
        figure.legend(loc="outside lower center", fontsize=8, ncols=5)
        return save(figure, "bench_sequence.png", "Where the time of a step goes")

    def _fresh_text(self) -> str:
        assert self.shape is not None
        assert self.displacement is not None
        lines = [
            f"`stereorig measure` on {SIZE} px with {thousands(bench.POINTS)} points from the start of the process to its end, kernels on disk, seeds "
            f"found by itself, on all cores: {self.shape.wall_s:.2f} s (processor {self.shape.cpu_s:.2f} s) for the shape, "
            f"{self.displacement.wall_s:.2f} s ({self.displacement.cpu_s:.2f} s) with a first displacement."
        ]
        for kind, (cold, warm) in self.cold.items():
            lines.append(
                f"With nothing compiled ({kind}): {cold.wall_s:.1f} s instead of {warm.wall_s:.1f} s, {cold.cpu_s - warm.cpu_s:.1f} s of processor time "
                "more, shape and motion in a process each. It happens once per machine and is announced."
            )
        return " ".join(lines)

    def _seeds_text(self) -> str:
        rows = [[f.what, str(f.threads), f"{f.wall_s:.2f}", f"{f.cpu_s:.2f}", str(f.seeds)] for f in self.seeds]
        return "\n\n".join(
            [
                "Seeds by themselves on 2448 x 2048 px: features of all images, matches, local fits, refined points. A motion from nothing known needs "
                "the features of four images.",
                table(["of", "threads", "wall / s", "processor / s", "seeds"], rows),
            ]
        )

    def _points_text(self) -> str:
        rows = [
            [
                thousands(p.points),
                *(f"{t:.2f}" for t in (p.shape_s, p.first_s, p.later_s)),
                f"{1e6 * p.later_s / p.points:.1f}",
            ]
            for p in self.points
        ]
        figure, ax = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
        n = [p.points for p in self.points]
        for what, times in (
            ("shape, with seeds", [p.shape_s for p in self.points]),
            ("first motion", [p.first_s for p in self.points]),
            ("later motion", [p.later_s for p in self.points]),
        ):
            ax.plot(n, times, "o-", label=what)
        ax.plot(n, [self.points[-1].later_s * k / n[-1] for k in n], ":", color="grey", label="in proportion")
        ax.set(xscale="log", yscale="log", xlabel="points", ylabel="s")
        ax.legend(fontsize=8)
        return "\n\n".join(
            [
                "One pair of 2448 x 2048 px, 21 px subsets, all threads, images prepared; the shape finds its seeds, whose cost the points share.",
                table(["points", "shape / s", "first motion / s", "later motion / s", "us a point, later"], rows),
                save(figure, "bench_points.png", "Time of a field against its points"),
            ]
        )

    def _memory_text(self) -> str:
        rows = [
            [f"{steps} steps, {SIZE} px, {thousands(bench.POINTS)} points", f"{used.peak_mb:.0f}"]
            for steps, used in sorted(self.memory.items())
        ]
        for steps, used in self.large.items():
            what = "a pair" if steps == 0 else f"a pair and {steps} step"
            rows.append([f"{what} of 6000 x 4000 px, 250,000 points", f"{used.peak_mb:.0f}"])
        return "\n\n".join(
            [
                "Peak resident memory of `stereorig measure`, interpreter and libraries included.",
                table(["", "MB"], rows),
            ]
        )


SIZE = f"{bench.SIZE_PX[0]} x {bench.SIZE_PX[1]}"


def measure_all(folder: Path, *, quick: bool, only: tuple[str, ...] = ()) -> Figures:
    """Measure everything, or the parts named in ``only``; prints the results."""
    wanted = only or PARTS
    out = Figures()
    counts = sorted({1, min(2, available_threads())})
    steps = 8 if quick else 20
    if "sequence" in wanted:
        runs = [(n, "tif", "cubic") for n in counts]
        if not quick:
            runs += [(counts[-1], "png", "cubic"), (counts[-1], "tif", "quintic")]
        for threads, suffix, kind in runs:
            found = bench.measure_sequence(folder, threads=threads, suffix=suffix, interpolation=kind, steps=steps)
            out.sequences.append(found)
            print(f"  {found}", flush=True)
    if "fresh" in wanted:
        bench.first_field(folder, steps=1)  # kernels on disk, files in the page cache
        out.shape = min((bench.first_field(folder, steps=0) for _ in range(3)), key=lambda used: used.wall_s)
        out.displacement = min((bench.first_field(folder, steps=1) for _ in range(3)), key=lambda used: used.wall_s)
        print(
            f"  first field {out.shape.wall_s:.2f} s, with a displacement {out.displacement.wall_s:.2f} s", flush=True
        )
        for kind in ("cubic",) if quick else ("cubic", "quintic"):
            out.cold[kind] = bench.cold_compile(folder, kind)
            print(f"  {kind}: {out.cold[kind][0].wall_s:.1f} s cold, {out.cold[kind][1].wall_s:.1f} s warm", flush=True)
    if "seeds" in wanted and not quick:
        for threads in counts:
            out.seeds += bench.measure_seeds(folder, threads=threads)
            print(f"  {out.seeds[-2:]}", flush=True)
    if "points" in wanted and not quick:
        out.points = bench.measure_points(folder, (1_000, 4_000, 16_000, 64_000, 250_000), threads=counts[-1])
        print(f"  {out.points}", flush=True)
    if "memory" in wanted:
        for n in (5, 15) if quick else (5, 50):
            out.memory[n] = bench.memory_of_sequence(folder, n)
        if not quick:
            out.large = {n: bench.memory_of_large_pair(folder, steps=n) for n in (0, 1)}
        print(f"  {[(n, round(u.peak_mb)) for n, u in (*out.memory.items(), *out.large.items())]} MB", flush=True)
    return out
