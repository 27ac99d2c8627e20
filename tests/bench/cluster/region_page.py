"""Writes the section of ``docs/explanation/cluster.md`` about one step split by region, beside what stands there."""

from __future__ import annotations

import os
import platform
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from core.settings import SPLIT_STEP_FROM
from tests.bench.documents.prose import wrapped

if TYPE_CHECKING:
    from tests.bench.cluster.region import Figures

PAGE = Path(__file__).resolve().parents[3] / "docs" / "explanation" / "cluster.md"
HEADING = "## One step by region"
_SECTION = re.compile(rf"\n{HEADING}\n.*?(?=\n## |\Z)", re.DOTALL)


def section_in(page: str) -> str:
    """Return the section of a page, empty where it has none."""
    found = _SECTION.search(page)
    return "" if found is None else found.group().strip()


def with_section(page: str, section: str) -> str:
    """Return a page with the section at its end, in place of the one that it has."""
    rest = _SECTION.sub("", page).rstrip()
    return f"{rest}\n\n{section}\n" if section else f"{rest}\n"


def write_section(figures: Figures, steps: list[str]) -> None:
    """Write the section into the page."""
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    PAGE.write_text(with_section(page, _section(figures, steps)), encoding="utf-8")


def _section(figures: Figures, steps: list[str]) -> str:
    megapixels = figures.size_px[0] * figures.size_px[1] / 1e6
    rows = zip(steps, figures.whole, figures.alone, figures.two, strict=True)
    measured = "\n".join(
        f"| {name} | {whole.own_s:.2f} | {one.own_s:.2f} | {two.own_s:.2f} | {two.others_s:.2f} | "
        f"{two.elsewhere} of {two.tiles} | {one.own_s / two.busiest_s:.2f} | {two.alone_s / two.busiest_s:.2f} |"
        for name, whole, one, two in rows
    )
    simulated = "\n".join(
        f"| {workers} | " + " | ".join(f"{times:.2f}" for times in found) + " |"
        for workers, found in figures.simulated.items()
    )
    share = [100.0 * two.tiles * two.a_tile_s / two.alone_s for two in figures.two]
    shares = ", ".join(f"{value:.0f} % of {name}" for value, name in zip(share, steps, strict=True))
    tile_bytes = max(two.tile_bytes for two in figures.two)
    return "\n\n".join(
        [
            HEADING,
            wrapped(
                "Where workers have nothing to do, a large step is split: a test with one step, the reference's shape, "
                "for which all others wait, fewer steps than workers. The worker that measures the step keeps what "
                "looks at all of it: seeds, noise, the checks, the choice of the patch, parts and further looks, strain, "
                "the calibration's common part and the files. What it gives away are fits of single points whose starts "
                "are known: in a step after another one from that; in a shape or a first motion from a coarse part of "
                "the points, a subset's width apart, over which the field grows first; with curved patches from the "
                "plane ones. A tile is a run of points in rows, a sixteenth of all, 16,384 at most. It lies in the analysis' folder with "
                "its starts; whoever is free takes one, reads the images, filters the rows that the tile needs, and "
                "puts the fits beside. A fit depends on its start and the images alone, so every number is that of one "
                "worker, to the last bit, and there is no seam. Nobody waits for a tile: what others have taken and not "
                "finished, by slowness or death, is fitted by the worker that wanted it."
            ),
            wrapped(
                f'`split_step = "auto"` splits steps of {SPLIT_STEP_FROM["auto"]:,.0f} usable points and more. Such '
                "fields grow in two passes whether or not anybody helps. Against growth in one piece (`never`) valid "
                "points are the same, values within 2 % of a standard deviation, rms: a fit that began elsewhere ends "
                "elsewhere by some thousandths of it. With `prefilter_px`, and where workers do not see the data folder, "
                "a step is not split."
            ),
            wrapped(
                f"Processor time, s, of a pair of {megapixels:.0f} megapixels, {figures.points:,} points of 33 px, strain "
                f"and files included, on {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {os.cpu_count()} cores; "
                "workers of one thread. Other programs share the cores, and the same work takes more processor time in one "
                "run than in the other; the last ratio is of the run of two workers alone: what the busiest one would have "
                "taken with all tiles as its own ones took it. The results of one worker and of two are "
                + ("the same to the last bit." if figures.same else "**not the same**.")
            ),
            "| step | one piece, one worker | split, one worker | of two: measures | of two: helps | tiles of the helper | "
            "times faster | within the run |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n" + measured,
            wrapped(
                f"Share of the processor time that can be given away: {shares}; the rest is what no number of workers "
                f"makes shorter. A tile's file is {tile_bytes / 1e6:.1f} MB, its fits {figures.fits_bytes} bytes a point. By "
                "these times, with workers that take a tile whenever they are free, times faster than one:"
            ),
            f"| workers | {' | '.join(steps)} |\n|{' --- |' * (len(steps) + 1)}\n" + simulated,
            wrapped(
                "More workers than tiles gain nothing. A long test is better spread by its steps: blocks come first, "
                "and a step is split only by workers that are left over."
            ),
        ]
    )
