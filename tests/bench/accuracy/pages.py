"""The tables on accuracy, a CSV file a topic, and the headline figures that ``docs/explanation/accuracy.md`` takes from them.

Lines of a table that begin with ``#`` hold a section's title, the conditions of its figures, its plots and its notes.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.bench.accuracy.table import Row, Section
from tests.bench.documents.prose import cell, marked

DOCS = Path(__file__).resolve().parents[3] / "docs"
FIGURES = DOCS / "figures"
TABLES = DOCS / "explanation" / "accuracy" / "tables"
HEADLINE_PAGE = DOCS / "explanation" / "accuracy.md"
COLUMNS = ("section", "what", "measured", "limit", "unit", "met")


@dataclass(frozen=True)
class Topic:
    """One table: its file's name, its heading on the page, and the names of the sections in it."""

    name: str
    title: str
    sections: tuple[str, ...]

    @property
    def table(self) -> Path:
        """The topic's file."""
        return TABLES / f"{self.name}.csv"

    @property
    def anchor(self) -> str:
        """The heading's anchor on the page."""
        return re.sub(r"[^a-z0-9 -]", "", self.title.lower()).replace(" ", "-")


TOPICS = (
    Topic("calibration", "Calibration", ("calibration", "aspect", "epipolar")),
    Topic(
        "any_rig", "Any lens, target and motion", ("lenses", "motions", "line-grid", "beside", "rigs", "real-boards")
    ),
    Topic("targets", "Targets", ("targets",)),
    Topic("shape_and_motion", "Shape and motion", ("plane", "translation", "strain", "rotation")),
    Topic("noise", "Random error and its bound", ("noise-random", "noise-model", "blur-in-time")),
    Topic("bias", "Bias over the sub-pixel phase", ("noise-mean", "prefilter")),
    Topic("curved_patches", "Curved patches", ("curved-sphere", "curved-noise", "curved-bending", "curved-auto")),
    Topic("large_motion", "Large motion in one step", ("large",)),
    Topic("cracks", "Cracks", ("cracks",)),
    Topic("strain", "Strain", ("strains", "strain-bending", "strain-rim")),
    Topic("gauges", "Gauges", ("gauges",)),
    Topic("cards", "Cards", ("cards",)),
    Topic("models", "Comparison with a model", ("models", "models-images")),
    Topic("long_sequences", "Long sequences", ("updates",)),
    Topic("smoothing", "Smoothing", ("smoothing",)),
    Topic(
        "faces", "Every face of a part", ("faces-plate", "faces-ball", "faces-misfit", "faces-cylinder", "faces-speed")
    ),
    Topic("difficult_images", "Difficult images", ("adversarial", "adversarial-reliefs")),
    Topic("experiments", "The paper's experiments, simulated", ("plate", "steel", "panel")),
    Topic("coverage", "Does the uncertainty cover", ("coverage",)),
    Topic("camera_bumps", "A camera that was bumped", ("bumps",)),
    Topic("specimen", "A real specimen", ("specimen", "strain-specimen")),
)

#: by topic and section: a row's name in its table, and its name on the page
HEADLINES: dict[tuple[str, str], dict[str, str]] = {
    ("calibration", "Calibration"): {
        "held-out RBE, profile localiser, exact grid, 1 frame, worst of 3": "reprojection error (RBE) at held-out positions, exact grid",
        "held-out RBE, profile localiser, 4 um grid, nodes corrected, 1 frame, worst of 3": "reprojection error at held-out positions, grid known to 4 um",
    },
    ("faces", "Plate with wedges"): {
        "27 px, 20 placements: found of the points on one face, least": "points found on wedges and steps without a seed"
    },
    ("coverage", "Does the calibration's part cover"): {
        "grid of 4 um: length of 25 mm, within 95 %": "lengths within their 95 % interval, grid known to 4 um"
    },
    ("coverage", "The whole chain through the command line"): {
        "coverage of 95 % intervals, mean of all cells": "values within their 95 % interval, whole chain"
    },
    ("any_rig", "Lenses"): {
        "p1 p2 of 3e-4: true shape error, rms (20 opencv5, 20 good)": "shape error after calibration of a decentred lens",
        "p1 p2 of 3e-4: reported over true": "reported over true shape error after that calibration",
    },
    ("any_rig", "Free poses beside OpenCV and mrcal"): {
        "k1 k2 p1 p2, board of 0.05 mm bowed by 0.3 mm: over OpenCV's, rms": "shape error over OpenCV's error, bad board in free poses"
    },
    ("any_rig", "Real boards"): {
        "here: epipolar distance of pairs left out, rms": "real boards: epipolar distance of pairs that the fit did not use"
    },
    ("targets", "Corners and dots"): {
        "checkerboard, 30 px apart, blur 1 px, tilt 50 degrees: rms error over the bound": "corner of a checkerboard: error over its Cramer-Rao bound"
    },
    ("shape_and_motion", "Plane"): {"plane, Z rms, 21 px": "Z on a plane, 21 px subset, rms"},
    ("shape_and_motion", "Translation"): {
        "translation, 21 px: u random": "u, 21 px subset, random error",
        "translation, 21 px: w random": "w, 21 px subset, random error",
        "translation, 21 px: mean w, worst of the fields": "w, 21 px subset, bias of the worst field",
    },
    ("shape_and_motion", "Strain"): {
        "stretch patch, 5 % strain, noise-free, rms of the worst component": "displacement at 5 % strain, noise-free, rms"
    },
    ("shape_and_motion", "Rotation"): {
        "rotation up to 25 degrees in plane (about Z), noise-free, rms of the worst component": "displacement at rotations to 25 degrees, noise-free, rms"
    },
    ("noise", "Random error and its bound"): {
        "standard texture, u, v, w, 21 px, quintic, noise 2: random error over its bound (+- 0.003)": "random error over its Cramer-Rao bound"
    },
    ("noise", "The camera's noise model"): {
        "u, v, w, 21 px, quintic, with the model: reported over empirical sd, departure from 1, worst component": "reported over empirical standard deviation, departure from 1"
    },
    ("bias", "Mean error over the sub-pixel phase"): {
        "paper rig, standard texture, quintic, noise-free: worst mean error over the phase": "bias over the sub-pixel phase, quintic spline"
    },
    ("curved_patches", "Curved patches: shape of a sphere"): {
        "sphere, 21 px, noise 2, plane: mean Z error": "bias of Z on a sphere of 30 mm, plane patches",
        "sphere, 21 px, noise 2, auto: mean Z error": "bias of Z on a sphere of 30 mm, `auto` (curved patches)",
    },
    ("large_motion", "Large motion in one step"): {
        "45 degrees in the plane: valid points": "valid points after a turn of 45 degrees in one step",
        "50 % strain, -20 % across: valid points": "valid points after 50 % strain in one step",
    },
    ("cracks", "Cracks drawn as lines"): {
        "valid points within half a subset of the line, with it": "valid points within half a subset of a crack",
        "opening: mean error, of the opening": "opening of a crack: bias",
    },
    ("strain", "Strain over a virtual gauge"): {
        "false strain, 5 mm out of plane, noise 2: mean, worst component": "false strain, moved by 5 mm out of plane, mean",
        "noise of exx, 9 points (4.1 mm)": "noise of exx, gauge of 9 points (4.1 mm)",
    },
    ("gauges", "Gauges"): {
        "all of these, root mean square": "empirical over reported standard deviation of gauges, rms"
    },
    ("cards", "Cards"): {
        "tensile tests, all laws and numbers: within 95 %": "numbers of tensile tests within their 95 % interval",
        "cracks, all numbers: within 95 %": "K, T, tip and J of cracks within their 95 % interval",
    },
    ("long_sequences", "Long sequences and later references"): {
        "drift per update, steps of 0.64 px all alike": "bias that each later reference adds"
    },
    ("difficult_images", "Pictures that invite wrong matches"): {
        "all: wrong points per 100,000 valid ones": "wrong points per 100,000 valid ones, spoiled images"
    },
    ("camera_bumps", "Bumps repaired from speckle"): {
        "all bumps, worst: epipolar offset left": "epipolar offset left after the repair of a bump, worst of 12"
    },
    ("experiments", "Clamped plate"): {
        "centre deflection at 689 kPa: error": "deflection of a clamped plate at 689 kPa, error"
    },
    ("experiments", "Cracked panel"): {
        "crack opening in the middle at 48.95 kN: error": "opening of a panel's crack at 48.95 kN, error"
    },
    ("specimen", "Real specimen"): {
        "step 2: points valid": "real specimen: valid points",
        "step 2: epipolar offset, sd about its mean": "real specimen: epipolar offset, standard deviation",
    },
}


def write_section(name: str, section: Section) -> Path:
    """Put a section into the table of its topic, in place of the one with its title; return the table."""
    topic = next(topic for topic in TOPICS if name in topic.sections)
    plots = [f"plot: docs/figures/{file}: {caption}" for file, caption in section.figures]
    return write_part(topic.name, section.title, [section.how, *plots, *section.notes], map(Row.cells, section.rows))


def write_part(topic_name: str, title: str, notes: Iterable[str], rows: Iterable[tuple[str, ...]]) -> Path:
    """Put a section's notes and rows (without its title) into a topic's table, in place of those with that title."""
    path = next(topic for topic in TOPICS if topic.name == topic_name).table
    text = io.StringIO()
    text.write(f"## {title}\n")
    text.writelines(f"# {line}".rstrip() + "\n" for note in notes for line in note.splitlines())
    csv.writer(text, lineterminator="\n").writerows((title, *row) for row in rows)
    parts = path.read_text(encoding="utf-8").split("\n## ")[1:] if path.exists() else []
    others = {part.split("\n", 1)[0]: f"## {part.rstrip()}\n" for part in parts}
    others[title] = text.getvalue()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(",".join(COLUMNS) + "\n" + "".join(others.values()), encoding="utf-8")
    return path


def table_rows(topic: Topic) -> Iterator[dict[str, str]]:
    """Yield a table's rows by the names of their columns."""
    lines = topic.table.read_text(encoding="utf-8").splitlines()
    return csv.DictReader(line for line in lines if not line.startswith("#"))


def _headlines() -> Iterator[str]:
    topics = {topic.name: topic for topic in TOPICS}
    yield "| what | measured | limit | unit | met | more |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for (name, section), shown in HEADLINES.items():
        topic = topics[name]
        found = {row["what"]: row for row in table_rows(topic) if row["section"] == section}
        for what, title in shown.items():
            row = found[what]
            met = "**no**" if row["met"] == "no" else row["met"]
            cells = (title, row["measured"], row["limit"], row["unit"], met)
            yield f"| {' | '.join(cells)} | [{topic.title}](#{topic.anchor}) |"


def _missed() -> Iterator[str]:
    limited, missed = 0, []
    for topic in TOPICS:
        case = ""
        for row in table_rows(topic):
            what = row["what"]
            if what.startswith("the same: "):
                what = case + what.removeprefix("the same")
            else:
                case = what.partition(":")[0]
            limited += row["met"] != ""
            if row["met"] == "no":
                missed.append(f"| {topic.title}: {cell(what)} | {row['measured']} | {row['limit']} | {row['unit']} |")
    yield f"Missed: {len(missed)} of the {limited} figures that have a limit."
    if missed:
        yield from ("", "| what | measured | limit | unit |", "| --- | --- | --- | --- |", *missed)


def write_headlines() -> None:
    """Write the headline figures, and the figures that miss their limits, between the page's marks."""
    text = "\n".join([*_headlines(), "", *_missed()])
    page = marked(HEADLINE_PAGE.read_text(encoding="utf-8"), "headlines", text)
    HEADLINE_PAGE.write_text(page, encoding="utf-8")
