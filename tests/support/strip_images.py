"""Tensile tests of a linear strip through rendered stereo images, with drawn errors of pixels, load and section."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.progress import no_progress
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.evaluations.door import evaluate
from stereorig.server.evaluations.tensile.document import MaterialCardFound
from stereorig.server.evaluations.tensile.evaluation import MaterialCard
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from tests.support.measure_command import SIZE, small_rig

E_MPA, NU, WIDTH, THICKNESS = 3000.0, 0.33, 10.0, 4.0
STRAINS = np.concatenate([[0.0, 0.0], np.linspace(0.0003, 0.0030, 10)])
SUBSET, NOISE_GREY = 21, 2.0
SECTION_U, SCALE_U, LOAD_U_N = 0.002, 0.002, 0.2
SETTINGS = {
    "standard": "iso_527_2",
    "width_mm": WIDTH,
    "thickness_mm": THICKNESS,
    "section_u": SECTION_U,
    "load_scale_u": SCALE_U,
    "load_u_n": LOAD_U_N,
}
TRUTH = {"Et": E_MPA, "mu": NU}


def cards(folder: Path, draws: int, seed: int) -> Iterator[MaterialCardFound]:
    """The cards of so many tests; the images are rendered once and get new noise in each."""
    rig, how = small_rig(), np.random.default_rng(seed)
    pair = StereoPair(rig.cam1.camera, rig.cam2.camera)
    options = RenderOptions(blur_px=rig.blur_px)
    clean = []
    for strain in STRAINS[1:]:
        scene = make_scene(rig, "strip", load=100.0 * float(strain), poisson=NU)
        clean.append([255.0 * render(scene, camera, SIZE, options=options) for camera in (pair.cam1, pair.cam2)])

    def taken(both: list[Any]) -> list[Any]:
        return [np.clip(np.rint(i + how.normal(0.0, NOISE_GREY, i.shape)), 0, 255).astype(np.uint8) for i in both]

    grid, measured = (
        PointGrid.rectangle(50, 45, 180, 155, spacing_px=8),
        MeasureOptions(subset_px=SUBSET, patch="affine"),
    )
    made: Any = MaterialCard()
    for draw in range(draws):
        reference = ReferencePair(pair, *taken(clean[0]))
        shape = reference.shape(grid, measured)
        gain, section = 1.0 + SCALE_U * how.normal(), 1.0 + SECTION_U * how.normal()
        files, home = [], folder / f"{draw}"
        home.mkdir(parents=True)
        for n, (strain, both) in enumerate(zip(STRAINS[1:], clean, strict=True), 1):
            field = reference.motion(*taken(both), grid, measured, shape=shape)
            load = gain * section * WIDTH * THICKNESS * E_MPA * float(strain) + LOAD_U_N * how.normal()
            files.append(home / f"step_{n:04d}.nc")
            of_step = surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
            about = Provenance({"subset_px": SUBSET}, {}, "1", step=n, extra={"load_n": f"{load}"})
            write_field(files[-1], field, about, of_step)
        document = evaluate(made, files, SETTINGS, no_progress).document
        assert isinstance(document, MaterialCardFound)
        yield document


def within(found: list[MaterialCardFound], symbol: str) -> float:
    """Share of the cards whose 95 % interval holds the strip's number."""
    numbers = [card.numbers[symbol] for card in found]
    held = [n.lower is not None and n.upper is not None and n.lower <= TRUTH[symbol] <= n.upper for n in numbers]
    return float(np.mean(held))
