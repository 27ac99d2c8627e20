"""The renderer against geometry and against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.sim.render import RenderOptions, pixel_weights, render
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import flat
from stereorig.sim.texture import dots, line_grid, speckle

SIZE = (512, 480)


def camera(gamma: float = -0.52) -> Camera:
    return Camera.from_paper(
        phd_px=12000.0,
        cx_px=255.0,
        cy_px=241.0,
        kappa_per_px2=1e-8,
        aspect=0.9617,
        alpha_rad=0.78,
        beta_rad=0.02,
        gamma_rad=gamma,
        x0_mm=0.3,
        y0_mm=-0.2,
        z0_mm=400.0,
    )


def brute_force(scene: Scene, cam: Camera, x: int, y: int, blur_px: float, n: int = 80) -> float:
    """One pixel of a flat, undeformed scene: core's own back-projection, a dense lattice, box times Gaussian."""
    reach = 0.5 + 5.0 * blur_px
    o = (np.arange(n) + 0.5) / n * 2 * reach - reach
    step = 2 * reach / n
    fine = (np.arange(400) + 0.5) / 400 - 0.5  # the box, by its own sum
    if blur_px > 0:
        w = np.exp(-((o[:, None] - fine) ** 2) / (2 * blur_px**2)).mean(1) / np.sqrt(2 * np.pi) / blur_px * step
    else:
        w = np.full(n, 1.0 / n)
    px = np.stack(np.meshgrid(x + o, y + o), -1)
    plane = scene.sys_from_body
    points = cam.back_project_to_plane(px, point_sys_mm=plane.translation_mm, normal_sys=plane.rotation[:, 2]).xyz_mm
    value = scene.texture.value(plane.inverse().apply(points)[..., :2])
    return float(w @ value @ w)


TILTED = RigidTransform(
    np.array([[0.96, -0.28, 0.0], [0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])
    @ np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]]),
    np.array([0.3, -0.1, 0.7]),
)


@pytest.mark.parametrize("blur_px", [0.0, 0.55])
@pytest.mark.parametrize("pose", [UPRIGHT, TILTED], ids=["upright", "tilted"])
def test_pixels_agree_with_brute_force(blur_px: float, pose: RigidTransform) -> None:
    scene = Scene(name="block", surface=flat(), texture=speckle(diameter_mm=0.14, seed=3), sys_from_body=pose)
    window = (300, 200, 308, 205)
    image = render(scene, camera(), SIZE, window=window, options=RenderOptions(blur_px=blur_px))
    truth = [[brute_force(scene, camera(), x, y, blur_px) for x in range(300, 308)] for y in range(200, 205)]
    # with the lens's blur a twentieth of a grey level of 255; a bare square has the mid-point rule's error
    np.testing.assert_allclose(image, truth, atol=6e-3 if blur_px == 0.0 else 2e-4)
    finer = render(scene, camera(), SIZE, window=window, options=RenderOptions(blur_px=blur_px, samples=12))
    np.testing.assert_allclose(finer, truth, atol=8e-4 if blur_px == 0.0 else 2e-5)


def test_grid_lines_agree_with_brute_force() -> None:
    scene = Scene(name="grid", surface=flat(), texture=line_grid(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03))
    x, y = (int(v) for v in np.round(camera().project([0.5, 0.0, 0.0]).xy))
    options = RenderOptions(blur_px=0.55)
    image = render(scene, camera(), SIZE, window=(x - 3, y - 3, x + 4, y + 4), options=options)
    truth = [[brute_force(scene, camera(), i, j, 0.55, 200) for i in range(x - 3, x + 4)] for j in range(y - 3, y + 4)]
    assert np.ptp(truth) > 0.2
    np.testing.assert_allclose(image, truth, atol=2e-4)


@pytest.mark.parametrize("gamma", [-0.52, 0.52])
def test_dots_appear_where_the_camera_projects_them(gamma: float) -> None:
    # a small disc: its image's centroid is the projected centre up to perspective, 0.0002 px here
    scene = Scene(name="dots", surface=flat(), texture=dots(pitch_mm=2.0, diameter_mm=0.2, rim_mm=0.05))
    image = render(scene, camera(gamma), SIZE)
    for point in ((0.0, 0.0, 0.0), (4.0, 2.0, 0.0), (-4.0, 4.0, 0.0), (0.0, -6.0, 0.0)):
        xy = camera(gamma).project(point).xy
        x, y = (int(v) for v in np.round(xy))
        patch = 0.85 - image[y - 9 : y + 10, x - 9 : x + 10]
        cols, rows = np.meshgrid(np.arange(x - 9, x + 10), np.arange(y - 9, y + 10))
        centroid = np.array([(patch * cols).sum(), (patch * rows).sum()]) / patch.sum()
        assert np.abs(centroid - xy).max() < 0.002


def test_weights_are_the_pixel_and_the_lens() -> None:
    for blur in (0.0, 0.3, 0.8):
        w = pixel_weights(8, blur)
        o = (np.arange(w.size) - (w.size - 1) / 2) / 8
        assert w.sum() == pytest.approx(1.0, abs=1e-12)
        # variance of a box of width 1 plus that of the Gaussian; the lattice's own 1/8 px cells add nothing
        assert (w * o**2).sum() == pytest.approx(1 / 12 + blur**2, abs=2e-3)


def test_a_body_that_ends_shows_its_background() -> None:
    scene = Scene(
        name="block", surface=flat(), texture=speckle(diameter_mm=0.14, seed=3), half_size_mm=(2.0, 2.0), background=0.3
    )
    image = render(scene, camera(), SIZE)
    assert np.isfinite(image).all()
    assert np.abs(image[:20] - 0.3).max() < 1e-12
    centre = image[200:280, 215:295]
    assert centre.max() > 0.8
    assert centre.min() < 0.12


def test_a_window_is_a_cut_out_of_the_whole() -> None:
    scene = Scene(name="block", surface=flat(), texture=speckle(diameter_mm=0.14, seed=3))
    whole = render(scene, camera(), (96, 80), options=RenderOptions(threads=2))
    part = render(scene, camera(), (96, 80), window=(10, 60, 50, 75))
    np.testing.assert_allclose(part, whole[60:75, 10:50], atol=1e-9)
    with pytest.raises(ValueError, match="window"):
        render(scene, camera(), (96, 80), window=(10, 60, 97, 75))
