"""Large motion in one step, with nothing to start from: what is found again, and how well."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.bench.accuracy.paper_rig import plane_scene, true_points, turn
from tests.bench.accuracy.table import Row, Section
from tests.bench.speed.scene import rig_of_size

SIZE_PX = (1200, 1100)
REGION = (400, 380, 800, 720)
SPACING_PX = 10
PX_MM = 0.039
WRONG_UM = 20.0  # half a pixel
Z = np.array([0.0, 0.0, 1.0])
Y = np.array([0.0, 1.0, 0.0])


def _turn(axis: Float, degrees: float) -> RigidTransform:
    return turn(axis, np.deg2rad(degrees))


def _shift(px: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([px * PX_MM, 0.0, 0.0]))


MOTIONS: dict[str, tuple[Float | None, RigidTransform | None]] = {
    "45 degrees in the plane": (None, _turn(Z, 45.0)),
    "30 degrees of tilt": (None, _turn(Y, 30.0)),
    "tilt 30, turned 45 degrees": (None, _turn(Y, 30.0) @ _turn(Z, 45.0)),
    "50 % strain, -20 % across": (np.diag([1.5, 0.8]), None),
    "50 % shear": (np.array([[1.0, 0.5], [0.0, 1.0]]), None),
    "300 px": (None, _shift(300.0)),
}


def large_motion(figures: Path) -> Section:
    """Measure each motion from its two pairs of images alone."""
    rig = rig_of_size(SIZE_PX)
    texture = rig.texture(1)
    still = plane_scene(texture)
    reference = ReferencePair(rig.pair, *rig.capture(still, seed=1, noise=2.0))
    grid = PointGrid.rectangle(*REGION, spacing_px=SPACING_PX)
    options = MeasureOptions(subset_px=33)
    shape = reference.shape(grid, options)
    rows, pictures = [], []
    for name, (in_plane, motion) in MOTIONS.items():
        moved = plane_scene(texture, in_plane=in_plane, motion=motion)
        images = rig.capture(moved, seed=2, noise=2.0)
        field = reference.motion(*images, grid, options, shape=shape)
        assert field.uvw_mm is not None
        _, truth = true_points(still, moved, rig.pair.cam1, grid.xy_px)
        error = 1e3 * np.linalg.norm(field.uvw_mm - truth, axis=-1)
        rows += [
            Row(f"{name}: valid points", 100.0 * float(field.valid.mean()), "%", 99.0, at_least=True),
            Row(f"{name}: error of a point, rms", float(np.sqrt(np.nanmean(error**2))), "um"),
            Row(f"{name}: wrong points among the valid", float((error[field.valid] > WRONG_UM).sum()), "", 0.0),
        ]
        there = rig.pair.cam1.project(field.xyz_mm + field.uvw_mm).xy
        pictures.append((name, images[0], there, error))
    _draw(figures / "accuracy_large_motion.png", pictures)
    return Section(
        "Large motion in one step",
        f"The modern rig with {SIZE_PX[0]} x {SIZE_PX[1]} px, noise 2, a speckled plane, 33 px, {grid.allowed.sum()} points; no step between, no seed given. "
        f"A point is wrong where it is off by more than {WRONG_UM:g} um, half a pixel.",
        rows,
        [("accuracy_large_motion.png", "Camera 1 after the motion, points coloured by their error")],
        [],
    )


def _draw(path: Path, pictures: list[tuple[str, NDArray[np.uint8], Float, Float]]) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(9, 5.9), layout="constrained")
    shown = None
    for axis, (name, image, there, error) in zip(axes.flat, pictures, strict=True):
        axis.imshow(image, cmap="gray", vmin=0, vmax=255)
        shown = axis.scatter(there[..., 0], there[..., 1], c=error, s=1.5, vmin=0.0, vmax=1.0, cmap="viridis")
        axis.set(title=name, xticks=[], yticks=[], xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
    assert shown is not None
    figure.colorbar(shown, ax=axes, label="error of u, v, w together, um", shrink=0.7)
    figure.savefig(path, dpi=64)
    plt.close(figure)
