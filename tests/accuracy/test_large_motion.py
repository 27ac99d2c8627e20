"""Motions that no start value bridges: found again from the images alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.points.features import detect
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.scattered_matches import scattered_motion
from stereorig.core.field.seeding.stretched import stretched_features, stretches
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.bench.accuracy.paper_rig import Rig, plane_scene, true_points, turn
from tests.bench.speed.scene import rig_of_size

SIZE = (760, 700)
REGION = (290, 270, 470, 430)


@cache
def rig() -> Rig:
    return rig_of_size(SIZE)


@cache
def reference() -> ReferencePair:
    return ReferencePair(rig().pair, *rig().capture(plane_scene(rig().texture(3)), seed=1, noise=2.0))


@pytest.mark.fault(39)
@pytest.mark.parametrize(
    ("in_plane", "motion"),
    [
        (None, turn(np.array([0.0, 0.0, 1.0]), np.deg2rad(45.0))),
        (None, turn(np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0), np.deg2rad(30.0))),
        (np.diag([1.5, 0.8]), None),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), None),
        (None, RigidTransform(np.eye(3), np.array([6.0, -4.0, 3.0]))),
    ],
    ids=["turn", "tilt", "strain", "shear", "shift"],
)
def test_it_is_found_again(in_plane: np.ndarray | None, motion: RigidTransform | None) -> None:
    still = plane_scene(rig().texture(3))
    moved = plane_scene(rig().texture(3), in_plane=in_plane, motion=motion)
    grid = PointGrid.rectangle(*REGION, spacing_px=15)
    field = reference().motion(*rig().capture(moved, seed=2, noise=2.0), grid, MeasureOptions(subset_px=33))
    _, truth = true_points(still, moved, rig().pair.cam1, grid.xy_px)
    assert field.valid.mean() > 0.99
    error = np.linalg.norm(field.uvw_mm[field.valid] - truth[field.valid], axis=-1)
    assert error.max() < 3e-3  # 0.08 px


def test_stretched_copies_keep_their_places() -> None:
    image = np.asarray(reference().image1.pixels)
    plain = detect(image)
    box = (150, 120, 600, 560)
    for stretch in stretches():
        copy = stretched_features(image, box, stretch)
        found = scattered_motion(copy, plain)
        assert len(found.xy_px) > 100
        assert (found.xy_px >= box[:2]).all()
        shift = np.linalg.norm(found.xy_px - found.xy_current_px, axis=1)
        assert np.median(shift) < 0.4


def test_the_copies_are_what_finds_a_large_strain() -> None:
    moved = plane_scene(rig().texture(3), in_plane=np.diag([1.5, 0.8]))
    current = detect(np.asarray(rig().capture(moved, seed=2, noise=2.0)[0]))
    image = np.asarray(reference().image1.pixels)
    box = (REGION[0], REGION[1], REGION[2], REGION[3])
    plain = len(scattered_motion(detect(image, box=box), current).xy_px)
    best = max(len(scattered_motion(stretched_features(image, box, s), current).xy_px) for s in stretches())
    assert best > 40
    assert best > 5 * plain
