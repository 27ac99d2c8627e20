"""A field's estimate of its plane patches' error, against averages over the subsets' own pixels."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.field.checks.patch_choice import advise, choose_patch
from stereorig.core.field.checks.plane_error import PlaneError, plane_error
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.patch import asked_for
from tests.support.matching_scene import Bent, paper_pair

STEP, SUBSET = 7.0, 21
CAMERA = paper_pair(size=400).cam1
X, Y = np.meshgrid(np.arange(60.0, 340.0, STEP), np.arange(60.0, 300.0, STEP))
XY = np.stack([X.ravel(), Y.ravel()], -1)
OFFSET = np.stack(np.meshgrid(*[np.arange(SUBSET) - SUBSET // 2] * 2), -1).reshape(-1, 2)
RAYS = CAMERA.rays_cam(XY).xyz_mm


def seen(before: Bent, after: Bent, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth at the reference and w times the current position, camera 1's frame, of what pixels see."""
    ab = before.material(CAMERA, xy)
    w = 1.0 / CAMERA.cam_from_sys.apply(before.position(ab))[..., 2]
    return w, CAMERA.cam_from_sys.apply(after.position(ab)) * w[..., None]


def field(before: Bent, after: Bent | None, *, noise_mm: float) -> tuple[PointFits, float]:
    """Points as plane patches that see all pixels alike measure them, and the rms of their error, mm."""
    moved = after is not None
    pixels = XY[:, None] + OFFSET
    design = np.column_stack([np.ones(len(OFFSET)), OFFSET])
    middle = np.linalg.pinv(design)[0]  # value in the middle of the best plane
    (w, G), (true_w, true_G) = seen(before, after or before, pixels), seen(before, after or before, XY)
    w, G = w @ middle, np.einsum("npk,p->nk", G, middle)
    position, true_position = RAYS / w[:, None], RAYS / true_w[:, None]
    error = position - true_position
    if moved:
        error = (G / w[:, None] - position) - (true_G / true_w[:, None] - true_position)
    points = PointFits.empty(len(XY), 3 if moved else 1)
    rng = np.random.default_rng(4)
    sigma = noise_mm * w**2 / np.linalg.norm(RAYS, axis=1)
    points.w[:, 0], points.G[:, :, 0] = w, G
    points.covariance[:] = 0.0
    if moved:
        sigma_G = noise_mm * w / np.sqrt(3.0)
        points.G[:, :, 0] += sigma_G[:, None] * rng.normal(size=(len(XY), 3))
        points.covariance[:, [1, 2, 3], [1, 2, 3]] = sigma_G[:, None] ** 2
    else:
        points.w[:, 0] += sigma * rng.normal(size=len(XY))
        points.covariance[:, 0, 0] = sigma**2
    points.status[:] = 0
    return points, float(np.sqrt((error**2).sum(1).mean()))


def estimate(points: PointFits, *, step: float = STEP) -> PlaneError | None:
    return plane_error(points, shape=X.shape, rays=RAYS, spacing_px=step, subset_px=SUBSET)


TILTED = np.linalg.qr(np.array([[1.0, 0.2], [0.1, 1.0], [0.35, -0.2]]))[0]
BULGE = Bent((1 / 30, 0.003, 1 / 45))


@pytest.mark.parametrize("noise_mm", [1e-6, 3e-4, 1e-3])
def test_the_error_of_a_shape(noise_mm: float) -> None:
    points, error = field(BULGE, None, noise_mm=noise_mm)
    estimated = estimate(points)
    assert estimated is not None
    assert error > 1.2e-3
    assert abs(estimated.error_mm / error - 1.0) < 0.05
    assert abs(estimated.noise_mm / noise_mm - 1.0) < 0.02
    assert estimated.below_mm >= estimated.error_mm


@pytest.mark.parametrize("noise_mm", [1e-6, 3e-4, 1e-3])
def test_the_error_of_a_motion(noise_mm: float) -> None:
    after = Bent((1 / 60, 0.0, 1 / 20), origin=np.array([0.1, -0.2, 0.4]))
    points, error = field(BULGE, after, noise_mm=noise_mm)
    estimated = estimate(points)
    assert estimated is not None
    assert error > 3e-4
    assert abs(estimated.error_mm / error - 1.0) < 0.15


def test_planes_that_lean_and_turn_show_no_error() -> None:
    turned = np.linalg.qr(np.array([[1.0, -0.3], [0.3, 1.0], [-0.2, 0.2]]))[0]
    for after in (None, Bent(basis=turned, origin=np.array([0.3, 0.1, -0.2]))):
        points, error = field(Bent(basis=TILTED), after, noise_mm=1e-6)
        assert error < 5e-6
        estimated = estimate(points)
        assert estimated is not None
        assert estimated.below_mm < 5e-6
        points, _ = field(Bent(basis=TILTED), after, noise_mm=3e-4)
        estimated = estimate(points)
        assert estimated is not None
        assert estimated.below_mm < 0.2 * estimated.noise_mm


def test_a_curved_surface_that_only_shifts_moves_without_error() -> None:
    points, _ = field(BULGE, Bent(BULGE.bend, origin=np.array([0.2, 0.1, -0.3])), noise_mm=1e-6)
    estimated = estimate(points)
    assert estimated is not None
    assert estimated.below_mm < 2e-6


def test_points_too_far_apart_or_too_few_say_nothing() -> None:
    points, _ = field(BULGE, None, noise_mm=3e-4)
    assert estimate(points, step=2.1 * SUBSET) is None
    points.reject(np.arange(len(XY)) % 7 > 0, 4)  # type: ignore[arg-type]
    assert estimate(points) is None


def test_plane_patches_asked_for_get_advice_where_curved_ones_would_err_less() -> None:
    asked = asked_for("affine", "affine")
    assert advise(asked, None) == asked
    fine = advise(asked, PlaneError(1e-4, 1.1e-4, 2e-4))
    assert (fine.quadratic_advised, fine.plane_error_mm, fine.plane_noise_mm) == (False, 1e-4, 2e-4)
    bad = advise(asked, PlaneError(1.8e-3, 1.9e-3, 2e-4))
    assert bad.quadratic_advised
    assert bad.patch == "affine"
    assert "1.8 um (rms) in displacement" in bad.reason
    curved = asked_for("quadratic", "quadratic")
    assert advise(curved, PlaneError(1.8e-3, 1.9e-3, 2e-4)) == curved


def test_auto_fits_nothing_twice_where_curvature_cannot_pay() -> None:
    class NoFits:
        comparisons = 3

    points, _ = field(Bent(basis=TILTED), Bent(), noise_mm=3e-4)
    choice = choose_patch(NoFits(), points, XY, estimate(points))  # type: ignore[arg-type]
    assert choice.patch == "affine"
    assert choice.sample == 0
    assert choice.asked == "auto"
    assert "less than" in choice.reason
