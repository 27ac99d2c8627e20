"""Strain of rendered pictures: rigid motions make none, even strain comes out, the uncertainty is the scatter's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.status import PointStatus
from stereorig.core.strain import StrainField, StrainOptions, surface_strain
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import flat
from stereorig.sim.texture import speckle
from tests.support import cut_scenes
from tests.support import field_bench as bench
from tests.support.strain_fields import turned

SIZE, grid, pair, rig = bench.SIZE, bench.grid, bench.pair, bench.rig
SUBSET = 21
FALSE_LIMIT = 20e-6  # what the project asks of itself


def _capture(motion: RigidTransform, in_plane: np.ndarray | None = None) -> list[np.ndarray]:
    """Grey levels, 0 to 255 unrounded, of a speckled plane."""
    scene = Scene(
        name="plane",
        surface=flat() if in_plane is None else flat(in_plane),
        texture=speckle(diameter_mm=0.13, seed=4),
        sys_from_body=motion @ UPRIGHT,
    )
    options = RenderOptions(blur_px=rig().blur_px)
    return [255.0 * render(scene, camera, SIZE, options=options) for camera in (pair().cam1, pair().cam2)]


def _noisy(images: list[np.ndarray], seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.clip(np.rint(g + rng.normal(0.0, 2.0, g.shape)), 0, 255).astype(np.uint8) for g in images]


def _strain(before: list[np.ndarray], after: list[np.ndarray], window: int = 7) -> StrainField:
    options = MeasureOptions(subset_px=SUBSET, patch="affine")
    reference = ReferencePair(pair(), *before)
    field = reference.motion(*after, grid(), options, shape=reference.shape(grid(), options))
    # 5 mm out of plane carry some points out of these small pictures; no other may be lost
    assert np.isin(field.status, (PointStatus.OK, PointStatus.OUTSIDE_IMAGE)).mean() > 0.98
    return surface_strain(field, StrainOptions(window=window), subset_px=SUBSET)


STILL = RigidTransform(np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("axis", "angle_deg", "shift_mm"),
    [
        ((0.0, 0.0, 1.0), 10.0, (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 5.0)),
        ((1.0, 1.0, 2.0), 10.0, (0.0, 0.0, 5.0)),
    ],
)
def test_false_strain_of_rigid_motions(axis, angle_deg, shift_mm) -> None:
    """5 mm out of plane and 10 degrees with the true calibration: at most 20 microstrain in the mean."""
    motion = RigidTransform(turned(axis, angle_deg), np.array(shift_mm))
    found = _strain(_capture(STILL), _capture(motion))
    e = found.strain[found.valid]
    assert len(e) > 150
    assert np.abs(e.mean(axis=0)).max() < FALSE_LIMIT
    assert np.abs(e).max() < 100e-6
    assert found.patch is not None
    assert np.abs(found.patch[found.valid].mean(axis=0)).max() < 3 * FALSE_LIMIT


def test_even_strain_under_rotation() -> None:
    """Two per cent and shear, turned by 5 degrees: gauge and patch both give the tensor of the formula."""
    F = np.array([[1.02, 0.004], [0.0, 0.994]])
    to_sys = UPRIGHT.rotation[:2, :2]
    e = to_sys @ (0.5 * (F.T @ F - np.eye(2))) @ to_sys.T
    motion = RigidTransform(turned((1.0, -1.0, 2.0), 5.0), np.array([0.1, 0.05, 0.3]))
    found = _strain(_capture(STILL), _capture(motion, F))
    exact = np.array([e[0, 0], e[1, 1], e[0, 1]])
    assert np.abs(found.strain[found.valid].mean(axis=0) - exact).max() < FALSE_LIMIT
    assert found.patch is not None
    assert np.abs(found.patch[found.valid].mean(axis=0) - exact).max() < 3 * FALSE_LIMIT


def test_uncertainty_of_repeated_pictures() -> None:
    """Reported uncertainty against the scatter of eight pairs of noisy pictures, window by window."""
    before, after = _capture(STILL), _capture(RigidTransform(np.eye(3), np.array([0.013, -0.02, 0.03])))
    found = [_strain(_noisy(before, k), _noisy(after, 100 + k), window=5) for k in range(8)]
    kept = np.logical_and.reduce([s.valid for s in found])
    scatter = np.sqrt(np.mean(np.var([s.strain[kept] for s in found], axis=0, ddof=1), axis=0))
    reported = np.sqrt(np.mean([s.sigma[kept] ** 2 for s in found], axis=(0, 1)))
    # eight pictures of some 60 independent windows: 5 % at two sigma
    np.testing.assert_allclose(reported / scatter, 1.0, atol=0.12)


@pytest.mark.fault(37)
def test_lips_of_an_open_crack_have_no_false_strain() -> None:
    """Two halves part by 120 um along a drawn line: on both lips the strain is zero within its reported uncertainty."""
    line = np.array([(0.0, 107.3), (263.0, 118.1)])
    marked = bench.grid(spacing_px=5.0, margin_px=36.0).with_cracks([line])
    reference = ReferencePair(bench.pair(), *cut_scenes.reference())
    current = cut_scenes.opened(cut_scenes.below(line))
    field = reference.motion(*current, marked, MeasureOptions(subset_px=SUBSET, patch="affine"))
    found = surface_strain(field, StrainOptions(window=7), subset_px=SUBSET)
    beside = np.abs(field.y_px - np.interp(field.x_px, line[:, 0], line[:, 1])) < 15.0
    assert found.valid[beside].mean() > 0.9
    share = (found.strain / found.sigma)[found.valid]
    assert np.abs(share).max() < 6.0
    assert np.abs(found.strain[found.valid & beside]).max() < 2e-3
    blind = surface_strain(replace(field, cuts=None), StrainOptions(window=7), subset_px=SUBSET)
    assert np.abs(blind.strain[blind.valid & beside]).max() > 2e-2
