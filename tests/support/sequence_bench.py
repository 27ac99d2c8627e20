"""Simulated sequences of a speckled plane, and what measures them as the command line and the service do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, PreviousStep, ReferencePair
from stereorig.core.settings import ReferenceUpdate
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.sim.scene import Scene
from tests.bench.accuracy.paper_rig import Rig, plane_scene, true_points, turn
from tests.bench.speed.scene import rig_of_size

SIZE = (520, 480)
GRID = PointGrid.rectangle(190, 180, 330, 300, spacing_px=14)
OPTIONS = MeasureOptions(subset_px=33, patch="affine")
Images = list[np.ndarray]


@cache
def rig() -> Rig:
    return rig_of_size(SIZE)


def plate(
    turned: float = 0.0,
    shift_mm: Sequence[float] = (0.0, 0.0, 0.0),
    in_plane: np.ndarray | None = None,
    pattern: int = 3,
) -> Scene:
    """The plate turned by some degrees in its plane, moved and stretched."""
    motion = replace(turn(np.array([0.0, 0.0, 1.0]), np.deg2rad(turned)), translation_mm=np.array(shift_mm))
    return plane_scene(rig().texture(3), in_plane=in_plane, motion=motion)


def still() -> Scene:
    return plane_scene(rig().texture(3), motion=RigidTransform.identity())


def capture(scene: Scene, seed: int, noise: float = 2.0) -> Images:
    return list(rig().capture(scene, seed=seed, noise=noise))


def capture_fading(scene: Scene, angle: float, seed: int) -> Images:
    """Pictures of a plate whose pattern has gone over to another one by an angle; at 90 degrees nothing is left."""
    a = np.deg2rad(angle)
    rng = np.random.default_rng(seed)
    one, two = (rig().capture(s, noise=0.0) for s in (scene, replace(scene, texture=rig().texture(4))))
    mixed = [110.0 + np.cos(a) * (x - 110.0) + np.sin(a) * (y - 110.0) for x, y in zip(one, two, strict=True)]
    return [expose(m, rng) for m in mixed]


def expose(clean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add noise and round to eight bits."""
    return np.clip(np.round(clean + rng.normal(0.0, 2.0, clean.shape)), 0, 255).astype(np.uint8)


def truth(scene: Scene, grid: PointGrid = GRID) -> np.ndarray:
    return true_points(still(), scene, rig().pair.cam1, grid.xy_px)[1]


def measure(
    images: Sequence[Sequence[np.ndarray]],
    mode: ReferenceUpdate,
    *,
    grid: PointGrid = GRID,
    options: MeasureOptions = OPTIONS,
) -> dict[int, Field]:
    """Measure a sequence."""
    pairs = [(MeasureImage(one), MeasureImage(two)) for one, two in images]
    reference = ReferencePair(rig().pair, *pairs[0])
    shape = reference.shape(grid, options)
    fields: dict[int, Field] = {}
    sequence = reference.sequence(
        shape, grid, options, reference_update=mode, images_of=lambda k: pairs[k], field_of=lambda k: fields[k]
    )
    for n in range(1, len(pairs)):
        fields[n] = sequence.measure(pairs[n], None if n == 1 else PreviousStep(n - 1, fields[n - 1]))
    return fields


def measure_from_files(
    images: Sequence[Sequence[np.ndarray]], known: dict[int, Field], n: int, mode: ReferenceUpdate, folder: Path
) -> Field:
    """Measure step ``n`` alone, from the files of the steps before."""
    for k, field in known.items():
        write_field(folder / f"step_{k:04d}.nc", field, Provenance({}, {}, "test", step=k))
    pairs = [(MeasureImage(one), MeasureImage(two)) for one, two in images]
    reference = ReferencePair(rig().pair, *pairs[0])
    write_field(folder / "step_0000.nc", reference.shape(GRID, OPTIONS), Provenance({}, {}, "test"))

    def field_of(k: int) -> Field:
        return read_field(folder / f"step_{k:04d}.nc")

    sequence = reference.sequence(
        field_of(0), GRID, OPTIONS, reference_update=mode, images_of=lambda k: pairs[k], field_of=field_of
    )
    return sequence.measure(pairs[n], PreviousStep(n - 1, field_of(n - 1)))
