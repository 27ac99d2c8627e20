"""Strain against analytic answers: even strain, rotation, inflation, gradients, edges, cracks."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import logm, sqrtm

from stereorig.core.errors import InputError
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.window import distinct_windows, window_offsets
from stereorig.core.status import PointStatus
from stereorig.core.strain import StrainField, StrainOptions, StrainStatus, surface_strain
from stereorig.core.strain.common_part import common_part
from stereorig.core.strain.on_surface import OnSurface
from stereorig.core.strain.reduced import whole_sums
from stereorig.core.strain.surface import surface_slopes
from stereorig.core.strain.tensors import pulls_of, strain_of, strain_slopes
from stereorig.core.strain.window import plane_weights
from tests.support.strain_fields import cylinder, make_field, plane, sphere, turned

F_SMALL = np.array([[1.001, 0.0004, 0], [-0.0002, 0.9995, 0], [0, 0, 1]])
F_LARGE = np.array([[1.2, 0.05, 0], [0.02, 0.93, 0], [0, 0, 1]])


def _strain(field, **options) -> StrainField:
    return surface_strain(field, StrainOptions(**options), subset_px=33)


def _without(field, empty):
    """The field with some points lost, as the measurement leaves them."""
    status = np.where(empty, PointStatus.LOW_CORRELATION, field.status).astype(np.int8)
    gone = {
        name: np.where(empty.reshape(empty.shape + (1,) * (a.ndim - 2)), np.nan, a)
        for name in ("xyz_mm", "normal_sys", "uvw_mm", "covariance", "rotation_rad", "stretch")
        if (a := getattr(field, name)) is not None
    }
    return replace(field, status=status, **gone)


@pytest.mark.parametrize("F", [F_SMALL, F_LARGE])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("turn_deg", [0.0, 10.0, 77.0])
def test_even_strain(F, order, turn_deg):
    """A homogeneous deformation, then a rotation: the tensors of the textbook, by matrix functions."""
    R = turned((0.2, -0.5, 1.0), turn_deg)
    C = (F.T @ F)[:2, :2]
    field = make_field(plane, lambda p: p @ (R @ F).T + np.array([1.0, -2.0, 5.0]))
    expected = {
        "green_lagrange": 0.5 * (C - np.eye(2)),
        "hencky": 0.5 * logm(C),
        "infinitesimal": (0.5 * (R @ F + (R @ F).T) - np.eye(3))[:2, :2],
    }
    for tensor, e in expected.items():
        found = _strain(field, order=order, tensor=tensor)
        assert found.valid.sum() > 0.9 * found.valid.size
        np.testing.assert_allclose(
            found.strain[found.valid], np.broadcast_to([e[0, 0], e[1, 1], e[0, 1]], (found.valid.sum(), 3)), atol=2e-11
        )


def test_frame_of_a_tilted_surface():
    """Axis 1 is X_sys projected on the surface, axis 2 completes it with the normal away from the cameras."""
    R = turned((1.0, 0.7, 0.3), 40.0)
    n = R[:, 2]
    axis1 = np.array([1.0, 0, 0]) - n * n[0]
    axis1 /= np.linalg.norm(axis1)
    frame = np.stack([axis1, np.cross(n, axis1)], axis=1)
    e = np.array([[0.01, 0.003], [0.003, -0.004]])
    stretch = np.eye(3) + frame @ e @ frame.T
    field = make_field(lambda a, b: plane(a, b) @ R.T, lambda p: p @ stretch.T)
    C = (np.eye(2) + e) @ (np.eye(2) + e)
    green = 0.5 * (C - np.eye(2))
    found = _strain(field)
    np.testing.assert_allclose(
        found.strain[found.valid],
        np.broadcast_to([green[0, 0], green[1, 1], green[0, 1]], (found.valid.sum(), 3)),
        atol=1e-11,
    )


@pytest.mark.parametrize("surface", [plane, cylinder(30.0), sphere(30.0)])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("angle", [0.01, 10.0, 45.0, 180.0])
def test_rigid_motion_is_no_strain(surface, order, angle):
    R = turned((0.3, 1.0, 0.4), angle)
    field = make_field(surface, lambda p: p @ R.T + np.array([0.0, 0.0, 5.0]))
    for tensor in ("green_lagrange", "hencky"):
        found = _strain(field, order=order, tensor=tensor)
        assert np.abs(found.strain[found.valid]).max() < 1e-11


@pytest.mark.parametrize("order", [1, 2])
def test_inflation(order):
    """A cylinder grows by 2 % in radius alone, a sphere by 2 % all over."""
    grow = 1.02
    R = 30.0
    field = make_field(cylinder(R), lambda p: (p - [0, 0, R]) * [grow, 1.0, grow] + [0, 0, R])
    found = _strain(field, order=order)
    exact = np.array([0.5 * (grow**2 - 1), 0.0, 0.0])
    assert np.abs(found.strain[found.valid] - exact).max() < 1e-9
    field = make_field(sphere(R), lambda p: (p - [0, 0, R]) * grow + [0, 0, R])
    found = _strain(field, order=order)
    exact = np.array([0.5 * (grow**2 - 1)] * 2 + [0.0])
    assert np.abs(found.strain[found.valid] - exact).max() < 1e-9


def _rolled(angle_deg, before_mm, after_mm, **more):
    """A sheet on a cylinder, rolled onto a narrower one about the same slanted axis: no strain at all."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))

    def on(radius, along, across):
        bent = (
            (radius * np.sin(along / radius), radius * (1.0 - np.cos(along / radius))) if radius else (along, 0 * along)
        )
        return np.stack([c * bent[0] - s * across, s * bent[0] + c * across, bent[1]], axis=-1)

    def surface(a, b):
        return on(before_mm, c * a + s * b, -s * a + c * b)

    def motion(p):
        chord, across = c * p[..., 0] + s * p[..., 1], -s * p[..., 0] + c * p[..., 1]
        along = before_mm * np.arcsin(chord / before_mm) if before_mm else chord
        return on(after_mm, along, across)

    return make_field(surface, motion, **more)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("angle_deg", "before_mm"), [(0.0, 0.0), (33.0, 0.0), (20.0, 90.0)])
def test_a_sheet_that_bends_has_no_strain(order, angle_deg, before_mm):
    """Planes would give h^2 / (10 R^2) too little, some 240 microstrain on R = 30 mm."""
    found = _strain(_rolled(angle_deg, before_mm, 30.0), window=9, order=order)
    x = 0.33 * np.arange(-4, 5)
    short = (x**4).sum() / (x**2).sum() / 6.0 * abs(1.0 / 30.0**2 - (before_mm and 1.0 / before_mm**2))
    assert short > 2e-4
    whole = np.s_[4:-4, 4:-4]
    assert np.abs(found.strain[whole]).max() < 0.01 * short
    assert np.abs(found.strain[found.valid]).max() < (0.01 if order == 1 else 0.3) * short
    assert found.valid.mean() > 0.9


def test_noise_does_not_bend_a_flat_sheet():
    """The curvature of noise has a square; what it makes of strain lies far below the noise."""
    field = _rolled(0.0, 0.0, 0.0)
    rng = np.random.default_rng(5)
    strains = []
    for _ in range(30):
        noisy = replace(field, uvw_mm=field.uvw_mm + rng.normal(size=field.uvw_mm.shape) * [2e-4, 2e-4, 4e-4])
        strains.append(_strain(noisy, window=5).strain)
    mean = np.nanmean(strains, axis=(0, 1, 2))
    assert np.abs(mean).max() < 2e-6
    assert np.nanstd(strains) > 3e-5


def test_strain_gradient_planes_and_quadratics():
    """exx = k x: whole windows agree; at an edge quadratics give the strain there, planes that in their middle."""
    k = 2e-4

    def pull(p):
        return p + np.stack([0.5 * k * p[..., 0] ** 2, 0 * p[..., 0], 0 * p[..., 0]], axis=-1)

    field = make_field(lambda a, b: np.stack([a, b, 0 * a], axis=-1), pull)
    planes, quadratics = (_strain(field, order=order, tensor="infinitesimal") for order in (1, 2))
    x = field.xyz_mm[..., 0]
    inner = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(planes.strain[inner], quadratics.strain[inner], atol=1e-12)
    np.testing.assert_allclose(planes.strain[inner][..., 0], k * x[inner], atol=1e-10)
    ok = quadratics.valid
    np.testing.assert_allclose(quadratics.strain[ok][:, 0], k * x[ok], atol=1e-9)
    assert planes.strain[15, 0, 0] == pytest.approx(k * x[15, 2], abs=1e-9)
    assert 3.0 < quadratics.sigma[15, 0, 0] / quadratics.sigma[15, 17, 0] < 12.0
    assert planes.status[0, 0] == StrainStatus.TOO_FEW


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal", "hencky"])
@pytest.mark.parametrize("order", [1, 2])
def test_the_strains_derivatives_over_the_positions_are_its_differences(tensor, order):
    """The surface rotates out of its plane by 0.1, where the frame's own tilt with the positions' noise counts."""
    F = turned((0.3, 1.0, 0.0), np.degrees(0.1)) @ F_SMALL
    field = make_field(lambda a, b: np.stack([a, b, 0.1 * a - 0.05 * b], axis=-1), lambda p: p @ F.T, shape=(7, 7))
    options = StrainOptions(window=7, tensor=tensor, order=order)
    slopes, surface, _, _ = surface_slopes(field, options, SharedPixels.of(field, 33))
    per_mm, strain = surface.per_mm, surface.strain
    at = int(np.flatnonzero((slopes.status == StrainStatus.OK).ravel()).tolist().index(3 * 7 + 3))
    D = strain_slopes(surface.pulls, tensor, per_mm, strain)[at]
    # the axes also turn within the plane, by a tenth of a tilt: that share of the strain, for slopes per mm
    small = 0.15 * np.abs(strain[at]).max() * np.abs(per_mm[at]).max()
    row, col = np.mgrid[-3:4, -3:4]
    step = 1e-6  # mm a point: the second order is 1e-6 of the first, rounding 1e-9
    for k in range(6):
        for a, way in enumerate((col, row)):
            found = []
            for sign in (-1.0, 1.0):
                shift = np.zeros((7, 7, 6))
                shift[..., k] = sign * step * way
                moved = replace(field, xyz_mm=field.xyz_mm + shift[..., :3], uvw_mm=field.uvw_mm + shift[..., 3:])
                found.append(surface_strain(moved, options, subset_px=33).strain[3, 3])
            difference = (found[1] - found[0]) / (2.0 * step)
            np.testing.assert_allclose(D[:, a, k], difference, atol=small, err_msg=f"component {k}, way {a}")


def test_derived_figures():
    U = np.array([[1.02, 0.004, 0], [0.004, 0.99, 0], [0, 0, 1.0]])
    found = _strain(make_field(plane, lambda p: p @ U.T), tensor="hencky")
    log = logm(U[:2, :2])
    values, vectors = np.linalg.eigh(log)
    ok = found.valid
    np.testing.assert_allclose(found.principal[ok], np.broadcast_to(values[::-1], (ok.sum(), 2)), atol=1e-11)
    angle = np.arctan(vectors[1, 1] / vectors[0, 1])
    np.testing.assert_allclose(found.angle_rad[ok], angle, atol=1e-8)
    np.testing.assert_allclose(found.max_shear[ok], 0.5 * (values[1] - values[0]), atol=1e-11)
    deviator = np.sqrt(values[0] ** 2 - values[0] * values[1] + values[1] ** 2)
    np.testing.assert_allclose(found.von_mises[ok], deviator, atol=1e-11)


@pytest.mark.parametrize("strain", [[2e-3, -6e-4, 5e-4], [1e-3, 1e-3, 8e-4], [-4e-4, 3e-4, -1e-3]])
def test_derived_figures_scatter_as_their_standard_deviations_say(strain):
    """Draws of exx, eyy, exy with correlated errors of a fortieth of the shear; 20,000 of them tell 1 %."""
    half = np.array([[3e-5, 0, 0], [1e-5, 2e-5, 0], [-1e-5, 5e-6, 2e-5]])
    even = _strain(make_field(plane, lambda p: p))
    drawn = np.array(strain) + np.random.default_rng(1).standard_normal((100, 200, 3)) @ half.T
    covariance = np.broadcast_to(half @ half.T, (100, 200, 3, 3))
    found = replace(even, strain=drawn, covariance=covariance, common=None)
    for value, sigma in (
        (found.principal[..., 0], found.sigma_principal[..., 0]),
        (found.max_shear, found.sigma_max_shear),
        (found.von_mises, found.sigma_von_mises),
        (np.unwrap(2.0 * found.direction_rad.ravel()) / 2.0, found.sigma_direction_rad),
    ):
        assert np.std(value) == pytest.approx(np.mean(sigma), rel=0.03)


def test_a_direction_that_noise_sets_is_withheld():
    """Of an even strain all directions are alike; one with a shear of 3 standard deviations of its own has one."""
    sigma = 2e-5
    even = _strain(make_field(plane, lambda p: p))
    shape = even.strain.shape
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (*shape, 3))
    noise = np.random.default_rng(2).normal(0.0, sigma, shape) * [1, 1, 0]
    alike = replace(even, strain=1e-3 * np.array([1, 1, 0]) + noise, covariance=covariance, common=None)
    assert np.isnan(alike.direction_rad).mean() > 0.8
    assert np.isnan(replace(alike, strain=np.zeros(shape)).direction_rad).all()
    sheared = replace(alike, strain=np.broadcast_to([0.0, 0.0, 3.0 * sigma], shape))
    np.testing.assert_allclose(sheared.direction_rad, np.pi / 4)
    np.testing.assert_allclose(sheared.sigma_direction_rad, 1.0 / (6.0 * np.sqrt(2.0)))
    # two fifths of that shear leave 0.29 rad
    assert np.isnan(replace(sheared, strain=sheared.strain * 0.4).direction_rad).all()


def test_gauge_size():
    found = surface_strain(
        make_field(lambda a, b: np.stack([a, b, 0 * a], -1), lambda p: p), StrainOptions(window=7), subset_px=21
    )
    assert found.gauge_px == 6 * 10 + 21
    assert found.gauge_mm == pytest.approx(81 * 0.033, rel=1e-9)


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal", "hencky"])
def test_patch_strain_is_the_same_tensor(tensor):
    """Stretch and rotation of the patches, made from the same deformation, agree with the gauge."""
    R = turned((0.2, -0.5, 1.0), 12.0)
    C = (F_LARGE.T @ F_LARGE)[:2, :2]
    U = np.real(sqrtm(C))
    polar = F_LARGE[:2, :2] @ np.linalg.inv(U)
    whole = R @ np.block([[polar, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])
    angle = np.arccos((np.trace(whole) - 1) / 2)
    axis = np.array([whole[2, 1] - whole[1, 2], whole[0, 2] - whole[2, 0], whole[1, 0] - whole[0, 1]])
    vector = axis / np.linalg.norm(axis) * angle
    field = make_field(
        plane, lambda p: p @ (R @ F_LARGE).T, stretch=np.array([U[0, 0] - 1, U[1, 1] - 1, U[0, 1]]), rotation_rad=vector
    )
    found = _strain(field, tensor=tensor)
    assert found.patch is not None
    np.testing.assert_allclose(found.patch[found.valid], found.strain[found.valid], atol=1e-10)


# one-sided windows: planes or quadratics


def _flat(a, b):
    return np.stack([a, b, 0 * a], axis=-1)


def _graded(k):
    """exx = k x to first order; k in 1/mm."""
    return make_field(_flat, lambda p: p + np.stack([0.5 * k * p[..., 0] ** 2, 0 * p[..., 0], 0 * p[..., 0]], axis=-1))


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal", "hencky"])
def test_a_steep_strain_takes_quadratics_at_the_rim_and_reports_their_noise(tensor):
    k = 3e-3
    field = _graded(k)
    one, two, auto = (_strain(field, order=order, tensor=tensor) for order in (1, 2, "auto"))
    e = k * field.xyz_mm[..., 0]
    exact = {"green_lagrange": e + 0.5 * e**2, "infinitesimal": e, "hencky": np.log1p(e)}[tensor]
    rim = (slice(5, -5), [0, 1, -2, -1])
    assert auto.raised[rim].all()
    # the third derivative that the tensor's square makes is left: k^2 over a window of 1.3 mm
    np.testing.assert_allclose(auto.strain[rim][..., 0], exact[rim], atol=2.0 * k**2)
    np.testing.assert_array_equal(auto.strain[rim], two.strain[rim])
    np.testing.assert_array_equal(auto.sigma[rim], two.sigma[rim])
    assert (np.abs(one.strain[rim][..., 0] - exact[rim]) > 2.0 * one.sigma[rim][..., 0]).all()
    whole = (slice(4, -4), slice(4, -4))
    assert not auto.raised[whole].any()
    np.testing.assert_array_equal(auto.strain[whole], one.strain[whole])
    np.testing.assert_array_equal(auto.covariance[whole], one.covariance[whole])


@pytest.mark.parametrize("k", [0.0, 3e-5, 1e-4, 2e-4, 1e-3])
def test_what_planes_leave_at_the_rim_lies_below_the_reported_uncertainty(k):
    """Also where they stay because their error is smaller than the noise of quadratics."""
    field = _graded(k)
    one, auto = _strain(field, tensor="infinitesimal", order=1), _strain(field, tensor="infinitesimal", order="auto")
    exact = k * field.xyz_mm[..., 0]
    error = np.abs(auto.strain[..., 0] - exact)[auto.valid]
    assert (error <= auto.sigma[..., 0][auto.valid]).all()
    kept = auto.valid & ~auto.raised
    np.testing.assert_array_equal(auto.strain[kept], one.strain[kept])
    assert (auto.sigma[kept] >= one.sigma[kept]).all()
    if k == 0.0:
        assert not auto.raised.any()
        np.testing.assert_array_equal(auto.covariance[auto.valid], one.covariance[auto.valid])
    np.testing.assert_array_equal(auto.valid, one.valid)


def test_a_bend_without_strain_leaves_planes_where_they_are():
    """A sheet rolled up to 20 mm: its second derivatives stand on the surface and are no gradient of strain."""
    radius = 20.0

    def rolled(p):
        s = p[..., 0] / radius
        return np.stack([radius * np.sin(s), p[..., 1], radius * (1.0 - np.cos(s))], axis=-1)

    found = _strain(make_field(_flat, rolled), order="auto")
    assert not found.raised.any()
    # what the curvature's correction leaves of h^4 / R^4 in windows of a few points: some 0.1 microstrain
    assert np.abs(found.strain[found.valid]).max() < 1e-6


@pytest.mark.parametrize("k", [2e-4, 1e-3, 3e-3])
def test_a_rotation_does_not_change_the_choice(k):
    R = turned((0.2, -0.5, 1.0), 33.0)
    plain = _graded(k)
    moved = replace(plain, uvw_mm=(plain.xyz_mm + plain.uvw_mm) @ R.T - plain.xyz_mm)
    for tensor in ("green_lagrange", "hencky"):
        a, b = _strain(plain, tensor=tensor, order="auto"), _strain(moved, tensor=tensor, order="auto")
        np.testing.assert_array_equal(a.raised, b.raised)
        np.testing.assert_allclose(a.strain[a.valid], b.strain[b.valid], atol=1e-12)
        assert a.raised.any() == (k > 2e-4)


def test_both_flanks_of_a_crack_have_the_strain_at_the_point():
    """The sides have gradients of their own; a window that the cut halves is as one-sided as one at the rim."""
    k = np.array([2e-3, -3e-3])
    x_cut = 100.0 + 10.0 * 17 + 5.0
    cuts = Cuts([[(x_cut, 0.0), (x_cut, 1000.0)]])

    def pull(p):
        side = (p[..., 0] > 0.165).astype(int)
        return p + np.stack([0.5 * k[side] * p[..., 0] ** 2 + 0.05 * side, 0 * p[..., 0], 0 * p[..., 0]], axis=-1)

    field = make_field(_flat, pull, cuts=cuts)
    found = _strain(field, tensor="infinitesimal", order="auto")
    side = (field.xyz_mm[..., 0] > 0.165).astype(int)
    exact = k[side] * field.xyz_mm[..., 0]
    flanks = (slice(5, -5), [16, 17, 18, 19])
    assert found.raised[flanks].all()
    np.testing.assert_allclose(found.strain[flanks][..., 0], exact[flanks], atol=1e-9)


# edges, holes, cracks


def _opened(p):
    """The right half moves away by 50 um, on a field strained by 1 per mil along Y."""
    return p * [1.0, 1.001, 1.0] + np.where(p[..., :1] > 0.05, [0.05, 0.0, 0.0], 0.0)


def test_no_window_reaches_over_a_cut():
    x_cut = 100.0 + 10.0 * 17 + 5.0
    cuts = Cuts([[(x_cut, 0.0), (x_cut, 1000.0)]])
    flat = lambda a, b: np.stack([a, b, 0 * a], axis=-1)  # noqa: E731
    found = _strain(make_field(flat, _opened, cuts=cuts))
    exact = [0.0, 0.5 * (1.001**2 - 1), 0.0]
    assert np.abs(found.strain[found.valid] - exact).max() < 1e-11
    assert found.valid[15, 17]
    assert found.valid[15, 18]
    blind = _strain(make_field(flat, _opened))
    assert np.nanmax(np.abs(blind.strain[..., 0])) > 0.01


@pytest.mark.parametrize("slant", [0, 1, 2])
def test_no_window_reaches_over_empty_points(slant):
    """A crack that was not drawn leaves a line of lost points, however it slants."""
    rows, cols = np.mgrid[:31, :35]
    lost = cols == 17 if slant == 0 else cols - 17 == (rows - 15) // slant
    right = cols > np.where(lost.any(axis=1), lost.argmax(axis=1), 17)[:, None]
    field = make_field(lambda a, b: np.stack([a, b, 0 * a], axis=-1), lambda p: p)
    moved = replace(field, uvw_mm=np.where(right[..., None], [0.05, 0.0, 0.02], 0.0))
    found = _strain(_without(moved, lost))
    assert np.abs(found.strain[found.valid]).max() < 1e-11
    assert (found.status[lost] == StrainStatus.NO_POINT).all()
    assert np.isnan(found.strain[lost]).all()
    assert found.valid.sum() > 700


@pytest.mark.parametrize("order", [1, "auto"])
def test_the_common_factor_goes_through_each_windows_own_weights(order):
    """Point by point in numpy, with edges, lost points and a cut."""
    rng = np.random.default_rng(4)
    field = make_field(
        sphere(80.0), lambda p: p @ F_SMALL.T, shape=(14, 15), cuts=Cuts([[[155.0, 70.0], [155.0, 130.0]]])
    )
    lost = rng.random(field.shape) < 0.05
    field = replace(_without(field, lost), common=rng.normal(size=(*field.shape, 6, 4)))
    options = StrainOptions(window=5, order=order)
    slopes, surface, _, _ = surface_slopes(field, options, SharedPixels(33))
    good = slopes.status == StrainStatus.OK
    D = np.zeros((*field.shape, 3, 12))
    D[good] = strain_slopes(surface.pulls, "green_lagrange", surface.per_mm, surface.strain).reshape(-1, 3, 12)
    found = common_part(field.common, field.valid, slopes, D, 2)
    own = {(r, c): w for rows, cols, many in slopes.reduced for r, c, w in zip(rows, cols, many, strict=True)}
    offsets = window_offsets(2)[0]
    for r, c in zip(*np.nonzero(good), strict=True):
        weights = own.get((r, c), plane_weights(2))
        used = (weights != 0.0).any(axis=0)
        at = offsets[used] + (r, c)
        moved = weights[:, used] @ field.common[at[:, 0], at[:, 1]].reshape(len(at), -1)
        assert found[r, c] == pytest.approx(D[r, c] @ moved.reshape(12, 4), rel=2e-5, abs=1e-6)
    assert len(own) > 50
    assert (~lost & good).sum() > 150


def test_only_windows_cut_off_alike_share_their_weights():
    """Each window's rows as they were given come back from its kind, and the kinds are those that a set counts."""
    rng = np.random.default_rng(5)
    kinds = rng.random((7, 81)) < 0.6
    seen = kinds[rng.integers(0, 7, 500)]
    found, which = distinct_windows(seen.T.copy().T)  # as connected_points gives them: columns lie side by side
    assert np.array_equal(found[which], seen)
    assert len(found) == len({row.tobytes() for row in seen})


def test_what_third_derivatives_add_to_a_slope_is_that_of_the_general_solution():
    """The plain twin solves the metric's equations by LAPACK; rounding alone is between them."""
    rng = np.random.default_rng(6)
    slope, second = rng.normal(size=(40, 6, 2)), rng.normal(size=(40, 6, 3))
    moments, towards = 0.1 * rng.normal(size=(40, 2, 4)), rng.normal(size=(40, 3))
    found = OnSurface.of(slope, second, moments, towards, np.empty((40, 6, 6)), "green_lagrange")
    for k in range(40):
        before = slope[k, :3] - _bias_by_lapack(slope[k, :3], second[k, :3], moments[k])
        now = slope[k, :3] + slope[k, 3:]
        now = now - _bias_by_lapack(now, second[k, 3:], moments[k])
        assert found.frame[k] @ np.linalg.inv(found.per_mm[k]) == pytest.approx(before, rel=1e-9, abs=1e-9)
        assert found.gradient[k] @ np.linalg.inv(found.per_mm[k]) == pytest.approx(now - before, rel=1e-9, abs=1e-9)
        normal = np.cross(*found.frame[k].T)
        assert normal @ before == pytest.approx([0.0, 0.0], abs=1e-9)
        assert normal @ towards[k] > 0.0


def _bias_by_lapack(slope, second, moments):
    x_s, x_t = slope.T
    normal = np.cross(x_s, x_t) / np.linalg.norm(np.cross(x_s, x_t))
    ss, st, tt = normal @ second
    along = -np.array([[ss * ss, ss * st], [ss * st, st * st], [st * st, tt * st], [tt * st, tt * tt]])
    third = np.linalg.solve(slope.T @ slope, along.T).T @ slope.T
    return (moments @ third).T


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal", "hencky"])
def test_the_compiled_strain_is_that_of_matrices(tensor):
    """Strain, its derivatives and its covariance of single points, by the matrices of the definitions."""
    rng = np.random.default_rng(7)
    n = 30
    slope = np.concatenate([rng.normal(size=(n, 3, 2)), 0.05 * rng.normal(size=(n, 3, 2))], axis=1)
    root = rng.normal(size=(n, 6, 6))
    around = root @ np.swapaxes(root, 1, 2)
    spread = np.array([[2.0, 0.3], [0.3, 1.0]]) * np.ones((n, 1, 1))
    flat = np.zeros((n, 6, 3)), np.zeros((n, 2, 4))
    found = OnSurface.of(slope, *flat, rng.normal(size=(n, 3)), around, tensor)
    covariance = found.covariance(spread, tensor)
    assert found.strain == pytest.approx(strain_of(found.frame, found.gradient, tensor), rel=1e-9, abs=1e-14)
    assert found.pulls == pytest.approx(pulls_of(found.frame, found.gradient, tensor), rel=1e-9, abs=1e-14)
    by_slope = strain_slopes(found.pulls, tensor, found.per_mm, found.strain)
    for k in range(n):
        # slopes' errors over column and row: spread times the points' covariance
        wanted = np.einsum("iap,ab,pq,jbq->ij", by_slope[k], spread[k], around[k], by_slope[k])
        assert covariance[k] == pytest.approx(wanted, rel=1e-9, abs=1e-9 * wanted.max())


def test_sums_over_whole_windows_are_those_of_each_window():
    """Filters down and along make one sum with the products of their weights; nothing lies beside the grid."""
    rng = np.random.default_rng(8)
    values, half = rng.normal(size=(7, 9, 4)), 2
    down, along = rng.normal(size=(2, 5)), rng.normal(size=(3, 5))
    found = whole_sums(values, down, along, (1, 0, 1))
    there = np.pad(values, ((half, half), (half, half), (0, 0)))
    for r in range(7):
        for c in range(9):
            part = there[r : r + 5, c : c + 5]
            wanted = np.stack([np.einsum("i,j,ijq->q", down[d], along[a], part) for a, d in enumerate((1, 0, 1))])
            assert found[r, c] == pytest.approx(wanted, rel=1e-12, abs=1e-13)


def test_islands_have_no_strain():
    """Few points, or points on one line, are refused; a single lost point costs its neighbours nothing."""
    field = make_field(plane, lambda p: p @ F_SMALL.T)
    lost = np.ones(field.shape, bool)
    lost[10, :] = False
    found = _strain(_without(field, lost), window=3, min_share=0.3)
    assert set(np.unique(found.status)) == {StrainStatus.NO_POINT, StrainStatus.TOO_FEW, StrainStatus.ONE_SIDED}
    assert np.isnan(found.strain).all()
    assert np.isnan(found.gauge_mm)
    lost = np.zeros(field.shape, bool)
    lost[15, 15] = True
    found = _strain(_without(field, lost))
    assert (found.valid[4:-4, 4:-4] == ~lost[4:-4, 4:-4]).all()


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"window": 4}, "strain_window_invalid"),
        ({"window": 1}, "strain_window_invalid"),
        ({"order": 3}, "option_out_of_range"),
        ({"tensor": "almansi"}, "option_out_of_range"),
        ({"min_share": 0.0}, "option_out_of_range"),
        ({"max_amplification": 0.5}, "option_out_of_range"),
    ],
)
def test_refused_options(options, code):
    with pytest.raises(InputError) as error:
        StrainOptions(**options)
    assert error.value.code == code


def test_a_shape_has_no_strain():
    field = make_field(plane, lambda p: p)
    with pytest.raises(InputError) as error:
        surface_strain(replace(field, uvw_mm=None), subset_px=33)
    assert error.value.code == "strain_needs_motion"


@pytest.mark.parametrize("shape", [(1, 20), (20, 1), (1, 1)])
def test_too_small_a_grid(shape):
    found = _strain(make_field(plane, lambda p: p, shape=shape))
    assert (found.status == StrainStatus.TOO_FEW).all()


def test_speed():
    """10,000 points with 2 % of them lost: a sequence can afford it."""
    field = make_field(plane, lambda p: p @ F_SMALL.T, shape=(100, 100))
    field = _without(field, np.random.default_rng(1).random(field.shape) < 0.02)
    _strain(field)
    start = time.process_time()
    _strain(field)
    assert time.process_time() - start < 2.0


def test_clamped_plate():
    """Deflection w0 (1 - r^2/a^2)^2; the face moves in the plane by half the thickness times the slope."""
    w0, a, thick = 0.4, 12.0, 1.5

    def slope(r):
        return -4.0 * w0 * r / a**2 * (1.0 - r**2 / a**2)

    def press(p):
        r = np.hypot(p[..., 0], p[..., 1])
        inward = -0.5 * thick * slope(r) / np.where(r > 0, r, 1.0)
        return p + np.stack([inward * p[..., 0], inward * p[..., 1], w0 * (1.0 - r**2 / a**2) ** 2], axis=-1)

    field = make_field(lambda x, y: np.stack([x, y, 0 * x], axis=-1), press, shape=(41, 41))
    found = _strain(field, window=3)
    x, y = field.xyz_mm[..., 0], field.xyz_mm[..., 1]
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    stretch = 2.0 * thick * w0 / a**2 * (1.0 - 3.0 * r**2 / a**2)  # d u_r / d r
    hoop = 2.0 * thick * w0 / a**2 * (1.0 - r**2 / a**2)  # u_r / r
    radial = stretch + 0.5 * (stretch**2 + slope(r) ** 2)
    around = hoop + 0.5 * hoop**2
    c, s = np.cos(phi), np.sin(phi)
    exact = np.stack([radial * c**2 + around * s**2, radial * s**2 + around * c**2, (radial - around) * c * s], axis=-1)
    inner = (slice(1, -1), slice(1, -1))
    # three points h apart take h^2 / 6 of the third derivative 12 t w0 / a^4 for slope, along and across the window
    assert np.abs(found.strain[inner] - exact[inner]).max() < 2.4 * 0.33**2 / 6.0 * 12.0 * thick * w0 / a**4
    assert np.abs(exact).max() > 8e-3
