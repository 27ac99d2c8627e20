"""Parts in relief: their pictures, and a measured field beside what it should have found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.status import PointStatus
from tests.support.relief_parts import calibrated
from tests.support.relief_rig import Body, Optics, ReliefCamera, Seen, exposed, picture, truth

WRONG_SIGMAS = 5.0
_ROUNDING_MM = 1e-9


class Measured(Protocol):
    """What of a field is held against the truth: (r, c) or (r, c, ...), mm."""

    @property
    def valid(self) -> NDArray[np.bool_]: ...

    @property
    def status(self) -> NDArray[np.int8]: ...

    @property
    def xyz_mm(self) -> NDArray[np.float64]: ...

    @property
    def sigma_mm(self) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class Found:
    """A measured field beside the truth.

    Attributes
    ----------
    on_one_face
        (r, c) True where both cameras see all of the subset, on one smooth face.
    face, status
        (r, c) the face that a point lies on, and the field's status.
    valid
        (r, c) the field's own.
    error_sigmas
        (r, c) largest error of X, Y and Z over its reported standard deviation; NaN where not valid.
    """

    on_one_face: NDArray[np.bool_]
    face: NDArray[np.int64]
    status: NDArray[np.int8]
    valid: NDArray[np.bool_]
    error_sigmas: NDArray[np.float64]

    @property
    def share(self) -> float:
        """Share found of the points on one face."""
        return float((self.valid & self.on_one_face).sum() / self.on_one_face.sum())

    @property
    def unreached(self) -> float:
        """Share of the points on one face that no start led to a match."""
        never = np.isin(self.status, (PointStatus.NOT_SEEDED, PointStatus.NOT_CONVERGED))
        return float((never & self.on_one_face).sum() / self.on_one_face.sum())

    @property
    def empty_faces(self) -> list[int]:
        """Faces of four or more points on one face, none of them valid."""
        faces, count = np.unique(self.face[self.on_one_face], return_counts=True)
        found = set(self.face[self.valid & self.on_one_face].tolist())
        return [int(f) for f, n in zip(faces, count, strict=True) if n >= 4 and int(f) not in found]

    @property
    def wrong(self) -> int:
        """Number of valid points further from the truth than five reported sigma."""
        return int((self.error_sigmas > WRONG_SIGMAS).sum())

    @property
    def worst(self) -> float:
        """Largest error of a valid point over its sigma."""
        return float(np.nanmax(self.error_sigmas))


@dataclass(frozen=True, eq=False)
class Part:
    """A part at rest before two cameras."""

    cameras: tuple[ReliefCamera, ReliefCamera]
    bodies: tuple[Body, ...]

    @cached_property
    def pair(self) -> StereoPair:
        return calibrated(self.cameras)

    @cached_property
    def clean(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        a, b = (picture(camera, self.bodies, Optics(samples=8)) for camera in self.cameras)
        return a, b

    def images(self, noise: float = 2.0, seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        rng = np.random.default_rng(seed)
        a, b = (exposed(grey, noise, rng) for grey in self.clean)
        return a, b

    def beside_truth(self, field: Measured, grid: PointGrid, subset_px: int) -> Found:
        seen = _truth_everywhere(self, subset_px)
        x, y = (np.rint(v).astype(int) for v in (grid.x_px, grid.y_px))
        assert (x == grid.x_px).all()
        assert (y == grid.y_px).all()
        with np.errstate(invalid="ignore"):
            # where a ray is square to an axis its depth moves nothing along that: what is left is rounding's
            off = np.abs(field.xyz_mm - seen.xyz_mm[y, x]) / np.maximum(field.sigma_mm[..., :3], _ROUNDING_MM)
        # a point whose centre sees nothing has no truth: valid, it is wrong
        off = np.where(field.valid[..., None], np.nan_to_num(off, nan=np.inf), np.nan)
        return Found(seen.one_face[y, x], seen.face[y, x], field.status, field.valid, off.max(axis=-1))


@lru_cache(maxsize=4)
def _truth_everywhere(part: Part, subset_px: int) -> Seen:
    """The truth at every pixel of camera 1."""
    w, h = part.cameras[0].size
    x, y = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    return truth(part.cameras, part.bodies, np.stack([x, y], axis=-1), subset_px=subset_px)
