"""The pages on accuracy: one a topic below ``docs/explanation/accuracy``, and one of headline figures taken from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tests.bench.accuracy.table import Row, Section
from tests.bench.documents.prose import wrapped

DOCS = Path(__file__).resolve().parents[3] / "docs"
FIGURES = DOCS / "figures"
TOPICS_FOLDER = DOCS / "explanation" / "accuracy"
HEADLINE_PAGE = DOCS / "explanation" / "accuracy.md"


@dataclass(frozen=True)
class Topic:
    """One page: its file's name, its title, and the names of the sections on it."""

    name: str
    title: str
    sections: tuple[str, ...]


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
    Topic("models", "Comparison with a model", ("models", "models-images")),
    Topic("long_sequences", "Long sequences", ("updates",)),
    Topic("smoothing", "Smoothing", ("smoothing",)),
    Topic(
        "faces",
        "Every face of a part",
        ("faces-plate", "faces-ball", "faces-misfit", "faces-cylinder", "faces-before", "faces-speed"),
    ),
    Topic("difficult_images", "Difficult images", ("adversarial", "adversarial-reliefs")),
    Topic("experiments", "The paper's experiments, simulated", ("plate", "steel", "panel")),
    Topic("coverage", "Does the uncertainty cover", ("coverage",)),
    Topic("camera_bumps", "A camera that was bumped", ("bumps",)),
    Topic("specimen", "A real specimen", ("specimen", "strain-specimen")),
)

_HEAD = """# Accuracy

Every figure was measured by `make accuracy`, which writes these pages anew; nothing is typed in. Images come from the
simulated rigs (`sim/`): analytic surfaces and textures, each sub-pixel's ray solved with the surface, no image warped or
interpolated. The noise is 2 of 255 grey levels unless a row says noise-free (then grey levels are not rounded either).
1 px is 33 um on the paper's rig. "At most" is the limit that the project sets itself; ue is microstrain.

Not in these figures: no real camera or stage was connected ([tested and not tested](tested.md)), and a real lens, light and
specimen add errors of their own. [Performance](performance.md) has the random error beside pyvale's on the same images.
"""

#: by topic and section: a row's text, and what it is called on the page of headlines
HEADLINES: dict[tuple[str, str], dict[str, str]] = {
    ("calibration", "Calibration"): {
        "held-out RBE, profile localiser, exact grid, 1 frame, worst of 3": "reprojection error (RBE) at held-out positions, exact grid",
        "held-out RBE, profile localiser, 4 um grid, nodes corrected, 1 frame, worst of 3": "the same, grid known to 4 um",
        "error in space, profile localiser, exact grid, 1 frame, rms over a 9 x 9 x 2 mm volume": "error in space, exact grid, rms",
    },
    ("calibration", "A wrong calibration"): {
        "camera 2's cy wrong by 0.1 px: mean false displacement, worst component": "false displacement, camera 2 off by 0.1 px"
    },
    ("faces", "Plate with wedges"): {
        "27 px, 20 placements: found of the points on one face, least": "wedges and steps without a seed: found of the points on one face"
    },
    ("coverage", "Does the calibration's part cover"): {
        "grid of 4 um: length of 25 mm, within 95 %": "lengths within their 95 % interval, grid known to 4 um"
    },
    ("any_rig", "Lenses"): {
        "p1 p2 of 3e-4: true shape error, rms (20 opencv5, 20 good)": "shape error after calibration of a decentred lens",
        "p1 p2 of 3e-4: reported over true": "reported over true shape error, the same",
    },
    ("any_rig", "Free poses beside OpenCV and mrcal"): {
        "k1 k2 p1 p2, board of 0.05 mm bowed by 0.3 mm: over OpenCV's, rms": "shape error over OpenCV's, bad board in free poses"
    },
    ("any_rig", "Real boards"): {
        "here: epipolar distance of pairs left out, rms": "real boards: epipolar distance of pairs left out"
    },
    ("targets", "Corners and dots"): {
        "checkerboard, 30 px apart, blur 1 px, tilt 50 degrees: rms error over the bound": "corner of a checkerboard: error over its bound"
    },
    ("shape_and_motion", "Plane"): {
        "plane, Z rms, 21 px": "Z on a plane, 21 px subset, rms",
        "plane, Z rms, 33 px": "Z on a plane, 33 px subset, rms",
    },
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
        "paper rig, standard texture, quintic, noise-free: worst mean error over the phase": "bias over the sub-pixel phase, quintic spline",
        "paper rig, standard texture, cubic, noise-free: worst mean error over the phase": "the same, cubic spline",
    },
    ("curved_patches", "Curved patches: shape of a sphere"): {
        "sphere, 21 px, noise 2, plane: mean Z error": "bias of Z on a sphere of 30 mm, plane patches",
        "sphere, 21 px, noise 2, auto: mean Z error": "the same, `auto` (curved patches)",
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
        "false strain, 10 degrees in plane, noise 2: mean, worst component": "false strain, turned by 10 degrees, mean",
        "noise of exx, 9 points (4.1 mm)": "noise of exx, gauge of 9 points (4.1 mm)",
    },
    ("gauges", "Gauges"): {
        "all of these, root mean square": "empirical over reported standard deviation of gauges, rms"
    },
    ("long_sequences", "Long sequences and later references"): {
        "drift per update, steps of 0.64 px all alike": "bias that each later reference adds"
    },
    ("difficult_images", "Pictures that invite wrong matches"): {
        "all: wrong points per 100,000 valid ones": "wrong points per 100,000 valid ones, spoiled images"
    },
    ("camera_bumps", "Bumps repaired from speckle"): {
        "all bumps, worst: epipolar offset left": "epipolar offset left after the repair of a bump, worst of 12",
        "all bumps, rms: false strain of shapes": "false strain of shapes after such a repair, rms",
    },
    ("experiments", "Clamped plate"): {
        "centre deflection at 689 kPa: error": "deflection of a clamped plate at 689 kPa, error",
        "radial strain at 689 kPa, rms off plate theory: error": "its radial strain off plate theory, rms",
    },
    ("experiments", "Cracked panel"): {
        "crack opening in the middle at 48.95 kN: error": "opening of a panel's crack at 48.95 kN, error"
    },
    ("specimen", "Real specimen"): {
        "step 2: points valid": "real specimen: valid points",
        "step 2: epipolar offset, sd about its mean": "real specimen: epipolar offset, standard deviation",
    },
}


def _text(section: Section) -> str:
    lines = [f"## {section.title}", "", section.how, "", Row.header()]
    lines += [row.markdown() for row in section.rows]
    lines.append("")
    for name, caption in section.figures:
        lines += [f"![{caption}](../../figures/{name})", ""]
    for note in section.notes:
        lines += [note, ""]
    return wrapped("\n".join(lines).rstrip()) + "\n"


def _parts(page: str) -> list[str]:
    """Return a page's head and its sections."""
    head, *sections = ("\n" + page).split("\n## ")
    return [head.lstrip("\n"), *(f"## {section}" for section in sections)]


def _title(part: str) -> str:
    return part.split("\n", 1)[0].removeprefix("## ")


def write_section(name: str, section: Section) -> Path:
    """Put a section into the page of its topic, in place of the one with its title; return the page."""
    topic = next(topic for topic in TOPICS if name in topic.sections)
    return write_part(topic.name, section.title, _text(section))


def write_part(topic_name: str, title: str, text: str) -> Path:
    """Put a part that begins with its title into a topic's page, in place of the one with that title."""
    topic = next(topic for topic in TOPICS if topic.name == topic_name)
    path = TOPICS_FOLDER / f"{topic.name}.md"
    head, *parts = _parts(path.read_text(encoding="utf-8")) if path.exists() else [f"# {topic.title}\n"]
    same = [i for i, part in enumerate(parts) if _title(part) == title]
    if same:
        parts[same[0]] = text
    else:
        parts.append(text)
    path.write_text("\n".join(part.rstrip() + "\n" for part in [head, *parts]), encoding="utf-8")
    return path


def _row(topic: str, section: str, what: str) -> list[str]:
    """Return measured value, limit, unit and verdict of a row, as the topic's page has them."""
    text = next(p for p in _parts((TOPICS_FOLDER / f"{topic}.md").read_text(encoding="utf-8")) if _title(p) == section)
    line = next(line for line in text.splitlines() if line.startswith(f"| {what} |"))
    return [part.strip() for part in line.strip("|").split("|")][1:]


def headline_page() -> str:
    """Return the page of headline figures, read off the topics' pages."""
    lines = [_HEAD, "| what | measured | at most | unit | met | more |", "| --- | --- | --- | --- | --- | --- |"]
    titles = {topic.name: topic.title for topic in TOPICS}
    for (topic, section), rows in HEADLINES.items():
        for what, shown in rows.items():
            lines.append(
                f"| {shown} | {' | '.join(_row(topic, section, what))} | [{titles[topic]}](accuracy/{topic}.md) |"
            )
    lines += ["", "## By topic", "", "```{toctree}", ":maxdepth: 1", ""]
    lines += [f"accuracy/{topic.name}" for topic in TOPICS]
    return "\n".join([*lines, "```"]) + "\n"


def write_headlines() -> None:
    """Write the page of headline figures."""
    HEADLINE_PAGE.write_text(headline_page(), encoding="utf-8")
