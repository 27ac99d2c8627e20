"""Models with formulas: the clamped plate of Eq. (18) and a plate with a hole (Kirsch), measured with drawn noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.model.surface import ModelSurface
from stereorig.core.status import PointStatus
from stereorig.core.strain import surface_strain
from stereorig.core.strain.options import StrainOptions
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.sim.plate import CircularPlate
from tests.support.strain_fields import make_field

Array = NDArray[np.float64]
SUBSET_PX, STEP_PX, MM_PER_PX = 30, 10.0, 0.033
PRESSURE_KPA = 344.5


def clamped_plate(stiffness: float = 1.0) -> Callable[[Array], Array]:
    """Displacement (..., 3) of the face of the paper's plate, towards -Z, its Young's modulus times ``stiffness``."""
    plate = CircularPlate(youngs_modulus_mpa=71.0e3 * stiffness)
    w0, a, t = plate.centre_deflection_mm(PRESSURE_KPA), plate.radius_mm, plate.thickness_mm

    def displacement(x: Array) -> Array:
        q = np.minimum((x[..., 0] ** 2 + x[..., 1] ** 2) / a**2, 1.0)
        along = 2.0 * t * w0 * (1.0 - q) / a**2  # (t / 2) (-w') / r
        return np.stack([along * x[..., 0], along * x[..., 1], -w0 * (1.0 - q) ** 2], axis=-1)

    return displacement


def kirsch(stiffness: float = 1.0, *, radius_mm: float = 2.0, stress_mpa: float = 60.0) -> Callable[[Array], Array]:
    """Displacement (..., 3) of an aluminium plate, 2 mm thick, under tension along X, with a round hole: plane stress.

    Timoshenko and Goodier's stresses, integrated; the face sinks by Poisson's ratio.
    """
    modulus, nu, thickness = 71.0e3 * stiffness, 0.334, 2.0
    shear, kappa = modulus / (2.0 * (1.0 + nu)), (3.0 - nu) / (1.0 + nu)
    scale = stress_mpa * radius_mm / (8.0 * shear)

    def displacement(x: Array) -> Array:
        p = np.maximum(np.hypot(x[..., 0], x[..., 1]) / radius_mm, 1e-6)
        angle = np.arctan2(x[..., 1], x[..., 0])
        c, s, c3, s3 = np.cos(angle), np.sin(angle), np.cos(3.0 * angle), np.sin(3.0 * angle)
        u = scale * (p * (kappa + 1.0) * c + 2.0 / p * ((1.0 + kappa) * c + c3) - 2.0 / p**3 * c3)
        v = scale * (p * (kappa - 3.0) * s + 2.0 / p * ((1.0 - kappa) * s + s3) - 2.0 / p**3 * s3)
        w = nu * thickness * stress_mpa / (2.0 * modulus) * (1.0 - 2.0 / p**2 * np.cos(2.0 * angle))
        return np.stack([u, v, w], axis=-1)  # the face that is seen looks along -Z

    return displacement


def mesh(
    displacement: Callable[[Array], Array], *, half_mm: float, spacing_mm: float = 0.1, hole_mm: float = 0.0
) -> ModelSurface:
    """Nodes on a square, round a hole on polar rows that fit it, in the plane Z = 0."""
    if hole_mm > 0.0:
        radius = hole_mm * np.geomspace(1.0, 1.5 * half_mm / hole_mm, 60)
        angle = np.linspace(0.0, 2.0 * np.pi, 361)[:-1]
        r, a = np.meshgrid(radius, angle, indexing="ij")
        nodes = np.stack([r * np.cos(a), r * np.sin(a), np.zeros_like(r)], axis=-1)
        first = np.arange(59)[:, None] * 360 + np.arange(360)
        across = np.arange(59)[:, None] * 360 + (np.arange(360) + 1) % 360
        quads = np.stack([first, first + 360, across + 360, across], axis=-1).reshape(-1, 4)
    else:
        count = round(2.0 * half_mm / spacing_mm) + 1
        side = np.linspace(-half_mm, half_mm, count)
        x, y = np.meshgrid(side, side)
        nodes = np.stack([x, y, np.zeros_like(x)], axis=-1)
        first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
        quads = np.stack([first, first + 1, first + count + 1, first + count], axis=-1)
    nodes = nodes.reshape(-1, 3)
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int64)
    return ModelSurface(nodes, displacement(nodes), triangles)


@dataclass(frozen=True, eq=False)
class Bench:
    """A measured field without noise, from which replicates with noise are drawn."""

    field: Field
    sigma_mm: tuple[float, float, float]

    def replicate(self, rng: np.random.Generator) -> Field:
        """Noise of white pixels through overlapping subsets, and unit causes of the common factor."""
        clean = self.field
        assert clean.uvw_mm is not None
        assert clean.common is not None
        cells = round(SUBSET_PX / STEP_PX)
        rows, cols = clean.shape
        white = rng.normal(size=(rows + 2 * cells, cols + 2 * cells, 6))
        # a subset is so many cells of a step: its value is their mean, scaled to variance one
        means = uniform_filter(white, size=(cells, cells, 1), mode="wrap")[cells : cells + rows, cells : cells + cols]
        own = cells * means
        own = np.einsum("rcij,rcj->rci", np.linalg.cholesky(clean.covariance), own)
        shared = clean.common @ rng.normal(size=clean.common.shape[-1])
        error = own + shared
        return replace(clean, xyz_mm=clean.xyz_mm + error[..., :3], uvw_mm=clean.uvw_mm + error[..., 3:])


def bench(
    displacement: Callable[[Array], Array],
    *,
    shape: tuple[int, int] = (61, 61),
    sigma_um: tuple[float, float, float] = (0.3, 0.3, 1.0),
    hole_mm: float = 0.0,
) -> Bench:
    """Measure a plane's displacement through subsets, each value the mean over the subset's square, 15 x 15 samples."""
    side = np.array(shape[::-1]) * 0.5 * STEP_PX * MM_PER_PX
    offset = (np.arange(15) - 7.0) / 15.0 * SUBSET_PX * MM_PER_PX
    ox, oy = np.meshgrid(offset, offset)

    def seen(x: Array) -> Array:
        out = np.zeros_like(x)
        for a, b in zip(ox.ravel(), oy.ravel(), strict=True):
            out += displacement(x + np.array([a, b, 0.0]))
        return x + out / ox.size

    field = make_field(lambda a, b: np.stack([a, b, np.zeros_like(a)], axis=-1), seen, shape=shape, spacing_px=STEP_PX)
    field = replace(field, normal_sys=np.broadcast_to([0.0, 0.0, -1.0], field.xyz_mm.shape))
    su, sv, sw = (1e-3 * s for s in sigma_um)
    covariance = np.zeros((*shape, 6, 6))
    for k, s in enumerate((su, sv, sw)):
        # two of three comparisons share the reference's noise: position and displacement correlate
        covariance[..., k, k], covariance[..., 3 + k, 3 + k] = s**2, 2.0 * s**2
        covariance[..., k, 3 + k] = covariance[..., 3 + k, k] = -0.5 * s**2
    x, y = field.xyz_mm[..., 0], field.xyz_mm[..., 1]
    assert field.uvw_mm is not None
    common = np.zeros((*shape, 6, 4))
    common[..., :3, 0], common[..., 3:, 0] = 2e-4 * field.xyz_mm, 2e-4 * field.uvw_mm  # a pitch
    common[..., 2, 1], common[..., 5, 1] = 1e-3 * x / side[0], 2e-4 * x / side[0]  # turns of a camera
    common[..., 2, 2], common[..., 5, 2] = 1e-3 * y / side[1], 2e-4 * y / side[1]
    common[..., 2, 3], common[..., 5, 3] = 2e-3 * (x / side[0]) ** 2, 1e-4 * (x / side[0]) ** 2  # a lens
    status = np.zeros(shape, np.int8)
    if hole_mm > 0.0:
        # subsets that reach into the hole are not measured
        status[np.hypot(x, y) < hole_mm + 0.71 * SUBSET_PX * MM_PER_PX] = PointStatus.MASKED
    field = replace(field, status=status, covariance=covariance, common=common, causes=Causes.unseparated(4))
    lost = status != 0
    for name in ("xyz_mm", "uvw_mm", "covariance", "common"):
        values = getattr(field, name).copy()
        values[lost] = 0.0 if name == "covariance" else np.nan
        field = replace(field, **{name: values})
    field.covariance[lost] = 1e-6 * np.eye(6)
    return Bench(field, (su, sv, sw))


def write_result(
    folder: Path, field: Field, *, n: int = 1, strain_window: int | None = 7, inputs: Mapping[str, str] | None = None
) -> Path:
    """Write a field as the result of step n; ``inputs``: checksums of what it was measured from."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{n:04d}.nc"
    strain = (
        None
        if strain_window is None
        else surface_strain(field, StrainOptions(window=strain_window), subset_px=SUBSET_PX)
    )
    provenance = Provenance(
        settings={"subset_px": SUBSET_PX, "spacing_px": STEP_PX},
        inputs={"calibration": "c0" * 32} if inputs is None else inputs,
        software_version="test",
        frame="system",
        step=n,
        extra={"reference_step": 0},
    )
    write_field(path, field, provenance, strain)
    return path


def write_model(path: Path, surface: ModelSurface, *, per_mm: float = 1.0) -> Path:
    """Write a model's surface, lengths times ``per_mm``, by another program's writer."""
    mesh = meshio.Mesh(
        per_mm * surface.nodes_mm,
        [("triangle", surface.triangles)],
        point_data={"displacement": per_mm * surface.displacement_mm},
    )
    meshio.write(path, mesh)
    return path
