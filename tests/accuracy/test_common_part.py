"""The calibration's part of the uncertainty: beside drawn calibrations, and through every quantity by brute force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from stereorig.core.calibration import COVARIANCE_NAMES
from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES, Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import FINE, KEPT, Causes, ParameterCovariance, common_factor, fewest_columns
from stereorig.core.errors import CalibrationInputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import align_3_2_1, align_plane, aligned
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.rigid import rigid_motion, without_rigid_motion
from stereorig.core.names import CAUSES
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.core.strain.mean import mean_strain_sigma
from stereorig.server.formats.results.layout import unpacked
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.calibrated_volume import covariance
from tests.support.field_bench import pair
from tests.support.gauge_field import SUBSET, make_field


def measured_numerically(drawn: StereoPair, seen: list[Any], seen_now: list[Any], before: Any, current: Any) -> Any:
    """What a measurement makes of images with drawn cameras: one step of least squares, slopes by differences.

    Unknowns: depth along camera 1's ray of the pixel, camera 2's offset across the epipolar line, the current point;
    equations: camera 2's image, both current images, weighed as the comparisons are, which share the reference's noise.
    """
    W = np.linalg.cholesky(np.linalg.inv(np.kron(np.eye(3) + 1.0, np.eye(2)))).T
    centre = drawn.cam1.centre_sys_mm
    ray = drawn.cam1.rays_cam(seen[0]).xyz_mm @ drawn.cam1.cam_from_sys.rotation
    along = drawn.cam2.project(before + ray).xy - drawn.cam2.project(before - ray).xy
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1)[:, None]
    depth = ((before - centre) * ray).sum(-1) / (ray * ray).sum(-1)

    def misses(x: Any) -> Any:
        offset = x[:, 1:2] * across
        point = centre + x[:, :1] * ray
        parts = (
            seen[1] - drawn.cam2.project(point).xy - offset,
            seen_now[0] - drawn.cam1.project(x[:, 2:]).xy,
            seen_now[1] - drawn.cam2.project(x[:, 2:]).xy - offset,
        )
        return np.concatenate(parts, axis=-1) @ W.T

    x = np.column_stack([depth, np.zeros(len(before)), current])
    for _ in range(2):
        steps = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
        slopes = np.stack([(misses(x + d) - misses(x - d)) / 2e-3 for d in steps], axis=-1)
        x = x - np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(slopes, misses(x), strict=True)])
    point = centre + x[:, :1] * ray
    return np.concatenate([point, x[:, 2:] - point], axis=-1)


def test_the_calibrations_part_is_the_scatter_of_drawn_calibrations() -> None:
    before = np.array([[0.0, 0.0, 0.0], [3.0, -2.0, 1.0], [-6.0, 5.0, 8.0]])
    current = before + np.array([0.5, 0.2, -2.0])
    factor = common_factor(ParameterCovariance(pair(), COVARIANCE_NAMES, covariance()), before, current)
    predicted = factor @ np.swapaxes(factor, 1, 2)
    rng = np.random.default_rng(5)
    drawn = rng.multivariate_normal(np.zeros(20), covariance(), 3000)
    seen = [[camera.project(points).xy for camera in (pair().cam1, pair().cam2)] for points in (before, current)]
    nominal = [camera.paper_parameters() for camera in (pair().cam1, pair().cam2)]
    found = []
    for change in drawn:
        cameras = [
            Camera.from_paper(
                **{**values, **{n: values[n] + d for n, d in zip(TEN_PARAMETER_NAMES, part, strict=True)}}
            )
            for values, part in zip(nominal, np.split(change, 2), strict=True)
        ]
        drawn_pair = StereoPair(*cameras)
        found.append(measured_numerically(drawn_pair, *seen, before, current))
    drawn_mm = np.asarray(found)
    np.testing.assert_allclose(np.sqrt(np.diagonal(predicted, axis1=1, axis2=2)), drawn_mm.std(axis=0), rtol=0.06)
    # and between the points: 3,000 draws give a correlation to 0.02
    joint = factor.reshape(18, -1) @ factor.reshape(18, -1).T
    scale = np.sqrt(np.diag(joint))
    np.testing.assert_allclose(joint / np.outer(scale, scale), np.corrcoef(drawn_mm.reshape(-1, 18).T), atol=0.06)


def moved_field(*, k: int = 3, failed: Any = None) -> Field:
    """A field with a smooth, made-up common factor, much larger than the noise."""
    turn = Rotation.from_rotvec([0.03, 0.01, 0.02]).as_matrix()
    field = make_field(lambda x: x @ turn.T + np.array([0.2, -0.1, 0.4]), failed=failed)
    x, y = field.xyz_mm[..., 0], field.xyz_mm[..., 1]
    waves = [np.sin(0.3 * (i + 1) * x + 0.2 * i * y + i) for i in range(6 * k)]
    common = 0.02 * np.stack(waves, axis=-1).reshape(*field.shape, 6, k)
    return replace(field, common=np.where(field.valid[..., None, None], common, np.nan))


def shifted(field: Field, column: int, size: float) -> Field:
    """The field with so much of one cause in it."""
    assert field.common is not None
    assert field.uvw_mm is not None
    off = size * field.common[..., column]
    return replace(field, xyz_mm=field.xyz_mm + off[..., :3], uvw_mm=field.uvw_mm + off[..., 3:])


def by_brute_force(field: Field, quantity: Callable[[Field], Any], size: float = 1e-4) -> Any:
    """What each cause of unit size does to a quantity, by differences: (..., k)."""
    assert field.common is not None
    columns = range(field.common.shape[-1])
    ends = [[np.asarray(quantity(shifted(field, c, s))) for s in (size, -size)] for c in columns]
    return np.stack([(a - b) / (2.0 * size) for a, b in ends], axis=-1)


SHARED = SharedPixels(SUBSET, curved=False)


def test_an_extensometer_sees_the_common_part_of_both_ends() -> None:
    field = moved_field()
    ends = ((60.0, 80.0), (133.0, 121.0))
    got = extensometer(field, *ends, shared=SHARED)
    own = extensometer(replace(field, common=None), *ends, shared=SHARED)
    for name in ("length0_mm", "length_mm", "elongation_mm", "strain", "true_strain"):
        seen = by_brute_force(field, lambda f, n=name: getattr(extensometer(f, *ends, shared=SHARED), n).value)
        reading, alone = getattr(got, name), getattr(own, name)
        assert reading.sigma_calibration == pytest.approx(np.linalg.norm(seen), rel=1e-5)
        assert reading.sigma == pytest.approx(np.hypot(alone.sigma, np.linalg.norm(seen)), rel=1e-5)
        assert np.isnan(alone.sigma_calibration)


def test_a_mean_does_not_reduce_the_common_part() -> None:
    field = replace(moved_field(), common=np.full((14, 17, 6, 1), 0.03))
    everywhere = np.ones(field.shape, bool)
    own = np.sqrt(field.covariance[..., 2, 2])
    got = area_statistics(
        field, field.xyz_mm[..., 2], own, everywhere, shared=SHARED, common=np.full((14, 17, 1), 0.03)
    )
    alone = area_statistics(field, field.xyz_mm[..., 2], own, everywhere, shared=SHARED)
    assert got.mean_sigma_calibration == pytest.approx(0.03)
    assert got.mean_sigma == pytest.approx(np.hypot(alone.mean_sigma, 0.03))
    assert np.isnan(alone.mean_sigma_calibration)


def test_a_rigid_motion_and_the_field_without_it_have_the_common_part_of_the_fit() -> None:
    field = moved_field()
    motion = rigid_motion(field, shared=SHARED)
    # small causes, so that they do not change the fit's weights, which follow the residuals
    held = replace(field, common=1e-4 * field.common)
    motion_held = rigid_motion(held, shared=SHARED)
    seen = by_brute_force(
        held,
        lambda f: np.concatenate(
            [rigid_motion(f, shared=SHARED).rotation_vector_rad, rigid_motion(f, shared=SHARED).translation_mm]
        ),
        size=1.0,
    )
    # the centre is the mean of the points, which move too: its part is in the translation by differences alone
    np.testing.assert_allclose(motion_held.sigma_common[:3], np.linalg.norm(seen, axis=1)[:3], rtol=2e-3)
    assert (np.diag(motion.covariance) >= motion.sigma_common**2).all()
    left = without_rigid_motion(held, motion_held, shared=SHARED)
    after = by_brute_force(
        held, lambda f: without_rigid_motion(f, rigid_motion(f, shared=SHARED), shared=SHARED).uvw_mm, size=1.0
    )
    assert left.common is not None
    scale = np.abs(after).max()
    np.testing.assert_allclose(left.common[..., 3:, :], after, atol=2e-3 * scale)


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal", "hencky"])
def test_strain_and_its_mean_have_the_common_part_of_their_windows(tensor: Any) -> None:
    failed = np.zeros((14, 17), bool)
    failed[4:6, 7:9] = True
    field = moved_field(failed=failed)
    options = StrainOptions(window=5, tensor=tensor, order=1)
    found = surface_strain(field, options, subset_px=SUBSET)
    seen = by_brute_force(field, lambda f: surface_strain(f, options, subset_px=SUBSET).strain)
    assert found.common is not None
    scale = np.nanmax(np.abs(seen))
    # by differences the frame and the arcs' correction follow the positions, too: second order in the slopes; and the
    # factor is rounded
    np.testing.assert_allclose(found.common[found.valid], seen[found.valid], atol=(0.01 + FINE) * scale)
    inside = np.zeros(field.shape, bool)
    inside[2:11, 3:14] = True
    total, part = mean_strain_sigma(field, options, inside, subset_px=SUBSET)
    own, none = mean_strain_sigma(replace(field, common=None), options, inside, subset_px=SUBSET)
    of_mean = np.linalg.norm(np.mean(found.common[inside & found.valid], axis=0), axis=-1)
    # a point's factor is rounded
    np.testing.assert_allclose(part, of_mean, rtol=2.0 * FINE)
    np.testing.assert_allclose(total, np.hypot(own, part), rtol=1e-9)
    assert np.isnan(none).all()


def test_a_frame_of_the_users_turns_the_factor_with_the_field() -> None:
    field = moved_field()
    frame = align_plane(field, shared=SHARED)
    assert field.common is not None
    turned = aligned(field, frame)
    assert turned.common is not None
    R = np.kron(np.eye(2), frame.rotation)
    np.testing.assert_allclose(turned.common, R @ field.common)
    np.testing.assert_allclose(turned.total_covariance, R @ field.total_covariance @ R.T, atol=1e-15)
    own = align_plane(replace(field, common=None), shared=SHARED)
    assert (np.diag(frame.covariance) >= np.diag(own.covariance)).all()
    six = [(60, 80), (130, 80), (60, 130), (60, 80), (130, 80), (60, 80)]
    by_six = align_3_2_1(field, six, shared=SHARED)
    assert np.trace(by_six.covariance) > np.trace(
        align_3_2_1(replace(field, common=None), six, shared=SHARED).covariance
    )


def test_a_file_gives_the_variance_of_a_difference(tmp_path: Path) -> None:
    field = moved_field()
    strain = surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
    path = tmp_path / "step_0001.nc"
    write_field(path, field, Provenance({"subset_px": SUBSET}, {}, "test"), strain)
    with xr.open_dataset(path) as data:
        assert data.common_factor.dims == ("row", "col", "component", "cause")
        assert data.common_factor.dtype == np.float32
        assert data.common_factor.units == "mm"
        F, total = data.common_factor.values.astype(float), unpacked(data.covariance.values.astype(float), 6)
        assert "row by row" in data.covariance.packed
        assert "calibration" in data.covariance.includes
    a, b = (2, 3), (9, 12)
    own = [total[p] - F[p] @ F[p].T for p in (a, b)]
    difference = own[0] + own[1] + (F[b] - F[a]) @ (F[b] - F[a]).T
    assert field.common is not None
    exact = field.covariance[a] + field.covariance[b]
    exact = exact + (field.common[b] - field.common[a]) @ (field.common[b] - field.common[a]).T
    np.testing.assert_allclose(difference, exact, rtol=1e-4, atol=1e-9)
    back = read_field(path)
    np.testing.assert_allclose(back.sigma_mm, field.sigma_mm, rtol=1e-5)
    np.testing.assert_allclose(np.diagonal(back.covariance, axis1=-2, axis2=-1).min(), 4e-8, rtol=0.05)
    read = read_strain(path)
    assert read is not None
    np.testing.assert_allclose(read.sigma[strain.valid], strain.sigma[strain.valid], rtol=1e-5)


def test_a_file_without_it_says_that_it_is_not_included(tmp_path: Path) -> None:
    field = replace(moved_field(), common=None)
    path = tmp_path / "step_0001.nc"
    write_field(path, field, Provenance({"subset_px": SUBSET}, {}, "test"))
    with xr.open_dataset(path) as data:
        assert "common_factor" not in data
        assert "not included" in data.covariance.includes
    assert read_field(path).common is None


def test_few_columns_hold_almost_all_of_every_points_variance() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-3.0, 3.0, (400, 3))
    source = ParameterCovariance(pair(), COVARIANCE_NAMES, covariance())
    factor = common_factor(source, points, points + np.array([0.4, -0.2, 0.8]))
    assert factor.shape[2] < 20
    L = source.root()
    np.testing.assert_allclose(L @ L.T, covariance(), rtol=1e-9, atol=1e-22)
    whole = rng.normal(size=(50, 6, 12)) * np.geomspace(1.0, 1e-4, 12)
    causes = Causes(("calibration",) * 5 + ("stage",) * 4 + ("target",) * 3, CAUSES)
    kept = fewest_columns(whole, causes)
    few = whole[..., kept]
    share = (few**2).sum(-1) / (whole**2).sum(-1)
    assert share.min() >= KEPT
    assert few.shape[2] < 12
    np.testing.assert_array_less(share, 1.0 + 1e-12)


def test_a_covariance_that_is_not_positive_is_refused_with_its_eigenvalue() -> None:
    bad = covariance()
    bad[0, 9] = bad[9, 0] = 1.2 * np.sqrt(bad[0, 0] * bad[9, 9])
    with pytest.raises(CalibrationInputError, match=r"eigenvalue of -0\.2") as error:
        ParameterCovariance(pair(), COVARIANCE_NAMES, bad).root()
    assert error.value.code == "covariance_not_positive"
