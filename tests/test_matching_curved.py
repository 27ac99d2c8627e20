"""Curved patches: bent surfaces that move, against the surfaces' own formulas and against the numpy twin."""

from __future__ import annotations

import numpy as np
import pytest
from matching_scene import Bent, Texture, opencv_pair, paper_pair, render, true_g6, true_w6
from matching_twin import Twin, pack

XY = np.array([[52.0, 61.0], [80.0, 80.0], [103.0, 94.0]])
# radii near 30 mm; at t the curvatures differ, and the middle moved, turned, stretched
BEFORE = Bent((1 / 30, 0.004, 1 / 40))
AFTER = Bent(
    (1 / 25, -0.003, 1 / 60),
    np.array([0.02, -0.01, 0.015]),
    np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]),
)


def scene(kind):
    pair = paper_pair(kappa=2e-8) if kind == "seidel" else opencv_pair()
    texture = Texture(blob_mm=0.05 if kind == "seidel" else 0.11)
    images = [render(camera, s, texture) for s in (BEFORE, AFTER) for camera in (pair.cam1, pair.cam2)]
    return pair, images, true_w6(pair.cam1, BEFORE, XY), true_g6(pair.cam1, BEFORE, AFTER, XY)


def displacement(pair, w, G):
    """(n, 3) mm, camera 1's frame."""
    return (G[..., :, 0] - pair.cam1.rays_cam(XY).xyz_mm) / w[..., :1]


@pytest.mark.parametrize("kind", ["seidel", "opencv"])
def test_the_twin_itself_finds_a_bent_surface_that_bends_on(kind):
    pair, images, w, G = scene(kind)
    # interpolation error and third order; the wide angle of the first rig tells depth much better than the second's
    depth_um, moved_um = (0.05, 0.05) if kind == "seidel" else (0.6, 0.3)
    for i, xy in enumerate(XY):
        twin = Twin(pair, images, xy, subset=25, order=5)
        p = twin.solve(pack(w[i], 0.0, G[i]))
        assert abs(p[0] / w[i, 0] - 1) * 400e3 < depth_um
        assert abs(p[6]) < 3e-3
        here = (p[7:].reshape(3, 6)[:, 0] - twin.centre) / p[0]
        there = (G[i, :, 0] - twin.centre) / w[i, 0]
        assert np.abs(here - there).max() * 1e3 < moved_um
        flat = twin.solve(pack(w[i, :3], 0.0, G[i, :, :3]))
        assert abs(flat[0] / w[i, 0] - 1) * 400e3 > 2.0  # what the curved patch is there for
