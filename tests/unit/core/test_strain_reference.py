"""The reference pair's share of a strain's noise, beside draws of that noise through the strain itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.field.points.result import Field
from stereorig.core.settings import StrainTensor
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.core.strain.reference import reference_share
from tests.support.gauge_field import make_field

OPTIONS = StrainOptions(window=5, order=1)
DRAWS = 10
TURN = Rotation.from_rotvec([0.1, -0.15, 0.3])


def turned_field() -> Field:
    """A steep plane, turned and stretched, whose frozen noise differs much by direction."""
    F = TURN.as_matrix() @ np.diag([1.02, 0.99, 1.0])
    plane = lambda x, y: np.stack(  # noqa: E731
        [0.02 * (x - 200.0), 0.02 * (y - 150.0), 0.6 * 0.02 * (x - 200.0) - 0.4 * 0.02 * (y - 150.0)], axis=-1
    )
    field = make_field(lambda x: x @ F.T, shape=plane, growing=False, rows=60, cols=60)
    C = 1e-2 * field.covariance
    root = np.linalg.cholesky(C[..., 3:, 3:])
    frozen = np.asarray(root @ np.diag([0.8, 0.3, 0.1]) @ np.swapaxes(root, -1, -2), dtype=np.float64)
    normal = np.array([-0.6, 0.4, 1.0]) / np.linalg.norm([-0.6, 0.4, 1.0])
    # positions and displacements without correlation, so that both parts can be drawn
    C[..., :3, 3:] = C[..., 3:, :3] = 0.0
    return replace(
        field,
        covariance=C,
        frozen=frozen,
        normal_sys=np.broadcast_to(-normal, field.xyz_mm.shape),
        rotation_rad=np.broadcast_to(TURN.as_rotvec(), field.xyz_mm.shape),
        stretch=None,
    )


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal"])
def test_the_share_is_that_of_drawn_noise(tensor: StrainTensor) -> None:
    field = turned_field()
    uvw, frozen_uvw = field.uvw_mm, field.frozen
    assert uvw is not None
    assert frozen_uvw is not None
    options = replace(OPTIONS, tensor=tensor)
    rng = np.random.default_rng(3)
    strain = surface_strain(field, options, subset_px=1)
    share = reference_share(field, strain)
    assert share is not None
    inner = np.s_[3:-3, 3:-3]

    def scatter(covariance: np.ndarray) -> np.ndarray:
        """Variance of exx, eyy, exy over draws of noise of all points, each its own, mean of the inner points."""
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(6))
        found = []
        for _ in range(DRAWS):
            noise = (root @ rng.standard_normal((*field.shape, 6, 1)))[..., 0]
            drawn = replace(field, xyz_mm=field.xyz_mm + noise[..., :3], uvw_mm=uvw + noise[..., 3:])
            found.append(surface_strain(drawn, options, subset_px=1).strain[inner] - strain.strain[inner])
        return np.asarray((np.array(found) ** 2).mean(axis=(0, 1, 2)))

    frozen = field.covariance.copy()
    frozen[..., 3:, 3:] = frozen_uvw
    drawn = scatter(frozen) / scatter(field.covariance)
    # 10 draws at 2,916 points, of which a window's 25 are as one: a variance is known to 4 %, their ratio to 6 %
    np.testing.assert_allclose(np.mean(share[inner], axis=(0, 1)), drawn, rtol=0.12)
    # of U and V alone it would be another
    plain = np.einsum("rcii->rc", frozen_uvw[..., :2, :2]) / np.einsum("rcii->rc", field.covariance[..., 3:5, 3:5])
    assert np.abs(plain[5, 5] / drawn - 1.0).max() > 0.2
