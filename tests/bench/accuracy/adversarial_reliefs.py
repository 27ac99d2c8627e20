"""Parts in relief that invite wrong matches: steps, slopes, occluding edges, holes, wires, gloss, defocus, JPEG, discs.

Pictures by a renderer that shares nothing with the program; the points lie densely on small pictures, so that every
edge is met in all positions. Every case is photographed twice, with other noise and points between those of the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.bench.accuracy.kept import kept
from tests.bench.accuracy.reliefs import jpeg
from tests.bench.accuracy.table import Row, Section
from tests.support.relief_parts import calibrated
from tests.support.relief_rig import (
    CYLINDER,
    HOLE,
    PLATEAU,
    RIDGE,
    SHEET,
    SPHERE,
    VALLEY,
    WIRE,
    Body,
    Feature,
    Optics,
    ReliefCamera,
    Texture,
    exposed,
    picture,
    truth,
    two_cameras,
)

SIZE = (420, 340)
SPACING_PX = 2.0
MOTION_SPACING_PX = 3.0
ROUNDS = 2
_MARGIN_PX = 26.0
WRONG_PX, WRONG_SIGMAS, ASKED_SIGMAS = 0.5, 10.0, 5.0
_FINE = Texture(wavelength_mm=0.6)
Picture = NDArray[np.uint8]


def _rad(degrees: float) -> float:
    return float(np.deg2rad(degrees))


@dataclass(frozen=True)
class Case:
    """A part, its subset and how it is photographed; ``moved`` are the bodies at t, in a measurement of a motion."""

    name: str
    subset_px: int
    bodies: tuple[Body, ...]
    optics: Optics = field(default_factory=lambda: Optics(samples=8))
    noise: float = 2.0
    after: Callable[[Picture], Picture] | None = None
    moved: tuple[Body, ...] | None = None


def _plate(*features: Feature, texture: Texture = _FINE) -> tuple[Body, ...]:
    return (Body(features, texture=texture),)


def _steps() -> tuple[Feature, ...]:
    return (
        Feature(PLATEAU, (-14.0, 0.0), (3.5, 9.0), 1.0),
        Feature(PLATEAU, (-4.0, 3.0), (4.0, 7.0), 3.0),
        Feature(PLATEAU, (9.0, 0.0), (5.0, 8.0), 10.0),
    )


def _ridges(first: float, second: float, valley: float) -> tuple[Feature, ...]:
    return (
        Feature(RIDGE, (-11.0, -1.0), (5.0, 10.0), 4.5 * np.tan(_rad(first)), _rad(first), 0.2),
        Feature(RIDGE, (3.0, 5.0), (5.0, 6.0), 4.0 * np.tan(_rad(second)), _rad(second)),
        Feature(VALLEY, (11.0, -7.0), (5.0, 6.0), 4.0 * np.tan(_rad(valley)), _rad(valley)),
    )


def _round() -> tuple[Feature, ...]:
    return (
        Feature(CYLINDER, (-9.0, 0.0), (7.0, 11.0), 7.5, _rad(60.0)),
        Feature(SPHERE, (8.0, 0.0), (8.0, 8.0), 8.5, _rad(60.0)),
    )


def _sheets() -> tuple[Feature, ...]:
    return (Feature(SHEET, (-12.0, 2.0), (5.0, 8.0), 6.0, turn=0.3), Feature(SHEET, (8.0, -3.0), (7.0, 6.0), 2.5))


def _apart() -> tuple[tuple[Body, ...], tuple[Body, ...]]:
    """Three pieces side by side that move apart by some tenths of a pixel to some pixels: cracks that open."""
    pieces = tuple(
        Body((Feature(SHEET, (x, 0.0), (half, 30.0), 0.0),), (0.0, 0.0), _FINE)
        for x, half in ((-27.0, 20.0), (0.0, 7.0), (27.0, 20.0))
    )
    shifts = ((0.0, 0.0, 0.0), (0.03, -0.01, 0.02), (0.1, 0.05, -0.05))
    return pieces, tuple(p.moved(np.eye(3), np.array(s)) for p, s in zip(pieces, shifts, strict=True))


def _turned() -> tuple[tuple[Body, ...], tuple[Body, ...]]:
    part = _plate(*_ridges(30.0, 45.0, 45.0), Feature(PLATEAU, (12.0, 8.0), (4.0, 4.0), 3.0))
    A = np.eye(3) + np.array([[0.003, -0.01, 0.0], [0.01, -0.001, 0.004], [0.0, -0.004, 0.0]])
    return part, tuple(body.moved(A, np.array([0.2, -0.1, 0.15])) for body in part)


def cases() -> list[Case]:
    """All of them."""
    apart, moved_apart = _apart()
    turned, moved_turned = _turned()
    blurred = Optics(samples=16, defocus_px_mm=0.15, focus_mm=300.0)
    discs = Texture(wavelength_mm=0.8, balls=True)
    obstructed = (
        Feature(HOLE, (-10.0, -5.0), (5.0, 5.0), 4.0),
        Feature(HOLE, (8.0, 5.0), (3.0, 3.0), 2.0),
        Feature(WIRE, (0.0, 0.0), (1.0, 40.0), 7.0, 0.25, 0.25),
    )
    return [
        Case("steps of 1, 3 and 10 mm", 21, _plate(*_steps())),
        Case("steps of 1, 3 and 10 mm", 33, _plate(*_steps())),
        Case("ridges of 30 and 45, valley of 45 degrees", 21, _plate(*_ridges(30.0, 45.0, 45.0))),
        Case("ridges of 55 and 65, valley of 55 degrees", 27, _plate(*_ridges(55.0, 65.0, 55.0))),
        Case("cylinder and sphere to 60 degrees", 21, _plate(*_round())),
        Case("cylinder and sphere to 60 degrees", 33, _plate(*_round())),
        Case("plates before a plate, occluding edges", 27, _plate(*_sheets())),
        Case("holes and a wire in front", 21, _plate(*obstructed)),
        Case("holes and a wire in front", 33, _plate(*obstructed)),
        Case("gloss", 27, _plate(*_steps(), *_round()[1:]), Optics(samples=8, gloss=0.5, gloss_rad=0.15)),
        Case("defocus by depth, 0.15 px a mm", 27, _plate(*_steps(), *_ridges(30.0, 45.0, 45.0)[:1]), blurred),
        Case("JPEG of quality 25", 33, _plate(*_ridges(30.0, 45.0, 45.0)), after=lambda p: jpeg(p, 25)),
        Case("sharp discs", 27, _plate(*_steps(), texture=discs)),
        Case("noise 8 on slopes", 33, _plate(*_ridges(30.0, 55.0, 45.0)), noise=8.0),
        Case("pieces that move apart", 21, apart, moved=moved_apart),
        Case("slopes that turn and shear", 27, turned, moved=moved_turned),
    ]


@dataclass(frozen=True)
class Outcome:
    """Counts of one case: valid points, wrong ones, those beyond five sigma, those asked for and found, worst error."""

    valid: int
    wrong: int
    beyond: int
    asked: int
    found: int
    worst_sigmas: float

    def __add__(self, other: Outcome) -> Outcome:
        return Outcome(
            self.valid + other.valid,
            self.wrong + other.wrong,
            self.beyond + other.beyond,
            self.asked + other.asked,
            self.found + other.found,
            max(self.worst_sigmas, other.worst_sigmas),
        )


def _numbers(case: Case, turn: int) -> dict[str, float]:
    return asdict(outcome(case, turn))


def outcome(case: Case, turn: int = 0) -> Outcome:
    """Photograph, measure and compare; ``turn`` counts the rounds."""
    cameras = two_cameras(SIZE)
    rng = np.random.default_rng(3 + turn)

    def taken(bodies: tuple[Body, ...]) -> tuple[Picture, Picture]:
        one, two = (exposed(picture(c, bodies, case.optics), case.noise, rng) for c in cameras)
        return (one, two) if case.after is None else (case.after(one), case.after(two))

    spacing = SPACING_PX if case.moved is None else MOTION_SPACING_PX
    w, h = SIZE
    first = _MARGIN_PX + 0.5 * turn * spacing
    grid = PointGrid.rectangle(first, first, w - _MARGIN_PX, h - _MARGIN_PX, spacing_px=spacing)
    reference = ReferencePair(calibrated(cameras), *taken(case.bodies))
    options = MeasureOptions(subset_px=case.subset_px)
    measured = (
        reference.shape(grid, options) if case.moved is None else reference.motion(*taken(case.moved), grid, options)
    )
    return _compared(cameras, case, measured, grid)


def _compared(cameras: tuple[ReliefCamera, ReliefCamera], case: Case, found: Field, grid: PointGrid) -> Outcome:
    at = np.stack([grid.x_px, grid.y_px], axis=-1)
    seen = truth(cameras, case.bodies, at, subset_px=case.subset_px, moved=case.moved)
    error = found.xyz_mm - seen.xyz_mm
    sigma = found.sigma_mm[..., :3]
    ends = [(found.xyz_mm, seen.xyz_mm)]
    if found.uvw_mm is not None:
        error = np.concatenate([error, found.uvw_mm - seen.uvw_mm], axis=-1)
        sigma = np.concatenate([sigma, found.sigma_mm[..., 3:6]], axis=-1)
        ends.append((found.xyz_mm + found.uvw_mm, seen.xyz_mm + seen.uvw_mm))
    with np.errstate(invalid="ignore"):
        px = np.max([np.linalg.norm(cameras[1].project(a) - cameras[1].project(b), axis=-1) for a, b in ends], axis=0)
    # where nothing is there is no truth: a valid point is wrong
    px = np.where(found.valid, np.nan_to_num(px, nan=np.inf), 0.0)
    sigmas = np.where(found.valid, np.nan_to_num(np.abs(error) / sigma, nan=np.inf).max(axis=-1), 0.0)
    return Outcome(
        int(found.valid.sum()),
        int(((px > WRONG_PX) | (sigmas > WRONG_SIGMAS)).sum()),
        int((sigmas > ASKED_SIGMAS).sum()),
        int(seen.one_face.sum()),
        int((seen.one_face & found.valid).sum()),
        float(sigmas.max()),
    )


def reliefs(figures: Path) -> Section:
    """Every case, and all of them together."""
    rows: list[Row] = []
    found: dict[str, Outcome] = {}
    for turn in range(ROUNDS):
        for case in cases():
            name = f"{case.name}, {case.subset_px} px"
            numbers = kept("reliefs", f"{name}, round {turn}", partial(_numbers, case, turn))
            one = Outcome(**{key: value if key == "worst_sigmas" else int(value) for key, value in numbers.items()})
            found[name] = found[name] + one if name in found else one
    for name, got in found.items():
        rows += [
            Row(f"{name}: valid points", float(got.valid), ""),
            Row("the same: valid of those on one face", 100.0 * got.found / max(got.asked, 1), "%"),
            Row("the same: wrong among valid", float(got.wrong), "", 0.0),
            Row(f"the same: valid beyond {ASKED_SIGMAS:g} sigma", float(got.beyond), "", 0.0),
            Row("the same: worst error over its sigma", got.worst_sigmas, "", ASKED_SIGMAS),
        ]
    every = sum(list(found.values())[1:], next(iter(found.values())))
    rows += [
        Row("reliefs: valid points", float(every.valid), "", 500_000.0, at_least=True),
        Row("reliefs: wrong points per 100,000 valid ones", 1e5 * every.wrong / every.valid, "", 1.0),
        Row(f"reliefs: valid points beyond {ASKED_SIGMAS:g} sigma per 100,000", 1e5 * every.beyond / every.valid, ""),
    ]
    return Section(
        "Reliefs that invite wrong matches",
        f"{SIZE[0]} x {SIZE[1]} px by a renderer that shares nothing with the program, a point every {SPACING_PX:g} px "
        f"({MOTION_SPACING_PX:g} in motions), {ROUNDS} rounds of other noise and points, noise 2 where not said, default options. A point is wrong if its position or displacement is off by more than "
        f"{WRONG_PX:g} px in camera 2 or by more than {WRONG_SIGMAS:g} of its reported standard deviations, or if there is no surface.",
        rows,
        [],
        [],
    )


SECTIONS = {"adversarial-reliefs": reliefs}
