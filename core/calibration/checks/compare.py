"""Comparison of two calibrations of one rig in space: positions from the same images, in units of their uncertainty.

Single parameters correlate at 0.9998 and more, so that two good calibrations may differ in all of them and agree in
every point. Points of the common volume are imaged by A's cameras; B's cameras measure these images. The frame is free:
a rigid motion is taken out. The remaining difference is compared with the covariances of both. Its thousands of
coordinates come from a few parameters, so the test is made in the space that the parameters span.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.changed import Changes, find_changes
from stereorig.core.calibration.result import COVARIANCE_NAMES
from stereorig.core.calibration.uncertainty import image_derivatives, point_derivatives
from stereorig.core.calibration.volume import CalibratedVolume
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError
from stereorig.core.robust import chi_square_tail

#: probability below which two calibrations differ: three standard deviations of a Gaussian
SIGNIFICANT = 0.0027
_MIN_POINTS = 12
_ROUNDS = 4
_RANK = 1e-9  # share of the largest singular value; the frame's motions leave zero to rounding
_TINY = 1e-12  # beyond it, no covariance is known well enough for a probability
_ACROSS, _DOWN, _DEPTHS = 9, 7, 5


@dataclass(frozen=True, eq=False)
class UncertainPair:
    """A calibrated pair and its covariance.

    Attributes
    ----------
    pair
        The cameras.
    names, covariance
        Names of the estimated parameters, and their covariance (n, n); None if it is not known.
    shared
        By name of a cause, L (n, k) with L L' its part of the covariance: errors that another calibration may share.
    """

    pair: StereoPair
    names: tuple[str, ...] = COVARIANCE_NAMES
    covariance: Float | None = None
    shared: Mapping[str, Float] = field(default_factory=dict)


@dataclass(frozen=True)
class Difference:
    """A difference and its standard deviation as both covariances predict it; None if a covariance is not known."""

    value: float
    sigma: float | None

    @property
    def ratio(self) -> float | None:
        """Value over standard deviation; None if that is not known."""
        return None if not self.sigma else self.value / self.sigma


@dataclass(frozen=True)
class CalibrationComparison:
    """Result of a comparison, B against A.

    Attributes
    ----------
    points
        Number of points compared.
    shape_rms_mm, shape_max_mm
        Distance of B's points from A's without the rigid motion: rms over points and coordinates, and the largest of a
        point, with its standard deviation along its own direction.
    scale
        Relative difference of size, part of the shape.
    epipolar_rms_px, epipolar_max_px
        Distance in camera 2 from B's epipolar lines of points that A images.
    chi_square, degrees, probability
        Test of all image differences together, in the space of the parameters; None without both covariances.
    unexplained_px
        Rms image difference that no change of the parameters makes, as of two lens models.
    shared
        Causes whose errors were taken for the same in both calibrations, so that they cancel.
    agrees
        True if the differences are those that the covariances predict; None without both.
    changes
        Differences of the cameras, and which of them explains the whole.
    text
        The finding in one sentence.
    """

    points: int
    shape_rms_mm: Difference
    shape_max_mm: Difference
    scale: Difference
    epipolar_rms_px: Difference
    epipolar_max_px: Difference
    chi_square: float | None
    degrees: int | None
    probability: float | None
    unexplained_px: float
    shared: tuple[str, ...]
    agrees: bool | None
    changes: Changes
    text: str


def volume_grid_mm(volume: CalibratedVolume, image_size_px: tuple[int, int]) -> Float:
    """Return points (n, 3), system frame: 9 x 7 over camera 1's image at 5 depths of the calibrated volume."""
    width, height = image_size_px
    near, far = (float(z) for z in volume.depth_mm[0])
    x, y, z = np.meshgrid(
        np.linspace(0.0, width - 1.0, _ACROSS),
        np.linspace(0.0, height - 1.0, _DOWN),
        np.linspace(near, far, _DEPTHS),
        indexing="ij",
    )
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    return volume.pair.cam1.back_project_at_depth(pixels, z.ravel()).xyz_mm


def common_points_mm(
    points_mm: Float,
    a: StereoPair,
    b: StereoPair,
    image_sizes_px: tuple[tuple[int, int], tuple[int, int]],
    *,
    volume_a: CalibratedVolume | None,
    volume_b: CalibratedVolume | None,
) -> Float:
    """Keep the points that both calibrations hold for.

    Parameters
    ----------
    points_mm
        (n, 3) A's system frame.
    a, b
        The pairs.
    image_sizes_px
        (width, height) of both cameras' images.
    volume_a, volume_b
        Calibrated volumes; None if one is not known.

    Returns
    -------
    Float
        (m, 3) points that A's cameras see, inside A's volume, and whose positions by B are inside B's volume.

    Raises
    ------
    CalibrationInputError
        ``calibrations_apart`` if hardly any is left.
    """
    images = [camera.project(points_mm) for camera in (a.cam1, a.cam2)]
    keep = np.ones(len(points_mm), dtype=bool)
    for image, size in zip(images, image_sizes_px, strict=True):
        with np.errstate(invalid="ignore"):
            keep &= image.valid & (image.xy >= -0.5).all(axis=-1) & (image.xy <= np.array(size) - 0.5).all(axis=-1)
    seen = b.triangulate(images[0].xy, images[1].xy)
    keep &= seen.valid
    if volume_a is not None:
        keep &= volume_a.contains(points_mm)
    if volume_b is not None:
        keep &= volume_b.contains(seen.xyz_mm)
    if keep.sum() < _MIN_POINTS:
        raise CalibrationInputError(
            f"Both calibrations have {int(keep.sum())} of {len(points_mm)} points in common; {_MIN_POINTS} are needed.",
            code="calibrations_apart",
            remedy="Compare calibrations of the same cameras, made over the same volume.",
        )
    return np.asarray(points_mm[keep])


def compare_calibrations(a: UncertainPair, b: UncertainPair, points_mm: Float) -> CalibrationComparison:
    """Compare the positions that two calibrations measure from the same images.

    Parameters
    ----------
    a, b
        The calibrations. Causes that both have in ``shared`` are one error in both; all else is independent.
    points_mm
        (n, 3) points in A's system frame, see :func:`common_points_mm`.

    Raises
    ------
    CalibrationInputError
        ``calibrations_apart`` if B cannot measure A's images.
    """
    images = np.stack([camera.project(points_mm).xy for camera in (a.pair.cam1, a.pair.cam2)])
    found = _measured(b.pair, images)
    if len(points_mm) < _MIN_POINTS or not np.isfinite(found).all():
        raise CalibrationInputError(
            "B's cameras cannot measure the images of A's points.",
            code="calibrations_apart",
            remedy="Compare calibrations of the same cameras.",
        )
    b_from_a = _best_motion(points_mm, found)
    moved = b_from_a.apply(points_mm)
    design = _motions(moved)
    shape = (found - moved).ravel()
    shape = shape - design[:, :6] @ np.linalg.lstsq(design[:, :6], shape, rcond=None)[0]
    epipolar = b.pair.epipolar_residual_px(images[0], images[1])
    scale_row = np.linalg.pinv(design)[6]
    flat = [
        (turn @ point_derivatives(own.pair, points, own.names)).reshape(shape.size, -1)
        for own, points, turn in ((a, points_mm, b_from_a.rotation), (b, moved, np.eye(3)))
    ]
    shapes = [f - design[:, :6] @ np.linalg.lstsq(design[:, :6], f, rcond=None)[0] for f in flat]
    roots = _roots(a, b, shapes)
    sigmas = _Predicted.of(a, b, (points_mm, moved), shapes, roots, scale_row)
    vectors = shape.reshape(-1, 3)
    worst = int(np.argmax(np.linalg.norm(vectors, axis=1)))
    scale = float(scale_row @ shape)
    statistic, degrees, outside, predicted_px = _test(a, b, points_mm, images, b_from_a, roots)
    probability = None if statistic is None else chi_square_tail(statistic, degrees)
    agrees = None
    if probability is not None and predicted_px is not None:
        agrees = probability >= SIGNIFICANT and outside <= 3.0 * predicted_px
    changes = find_changes(
        a.pair, b.pair, (a.names, b.names), roots, scale=(scale, sigmas.scale), significant=SIGNIFICANT
    )
    shape_rms = Difference(float(np.sqrt(np.mean(shape**2))), sigmas.shape_rms_mm)
    shared = () if roots is None else tuple(name for name in a.shared if name in b.shared)
    text = _text(shape_rms, agrees, probability, changes, shared)
    return CalibrationComparison(
        points=len(points_mm),
        shape_rms_mm=shape_rms,
        shape_max_mm=Difference(float(np.linalg.norm(vectors[worst])), sigmas.along(worst, vectors[worst])),
        scale=Difference(scale, sigmas.scale),
        epipolar_rms_px=Difference(float(np.sqrt(np.mean(epipolar**2))), sigmas.epipolar_rms_px),
        epipolar_max_px=Difference(float(np.abs(epipolar).max()), sigmas.epipolar_at(int(np.argmax(np.abs(epipolar))))),
        chi_square=statistic,
        degrees=degrees,
        probability=probability,
        unexplained_px=outside,
        shared=shared,
        agrees=agrees,
        changes=changes,
        text=text,
    )


@dataclass(frozen=True, eq=False)
class _Predicted:
    """Standard deviations of the differences, (n, 3, 3) and (n,) of each point; None if they are not known."""

    shape_mm2: Float | None
    scale: float | None
    epipolar_px2: Float | None

    @staticmethod
    def of(
        a: UncertainPair,
        b: UncertainPair,
        points: tuple[Float, Float],
        shapes: Sequence[Float],
        roots: tuple[Float, Float] | None,
        scale_row: Float,
    ) -> _Predicted:
        if roots is None:
            return _Predicted(None, None, None)
        D = shapes[1] @ roots[1] - shapes[0] @ roots[0]
        each = D.reshape(-1, 3, D.shape[1])
        rows = [_epipolar_rows(own, own_points) for own, own_points in zip((a, b), points, strict=True)]
        epipolar = rows[1] @ roots[1] - rows[0] @ roots[0]
        scale = float(np.linalg.norm(scale_row @ D))
        return _Predicted(each @ np.swapaxes(each, 1, 2), scale, (epipolar**2).sum(axis=1))

    @property
    def shape_rms_mm(self) -> float | None:
        if self.shape_mm2 is None:
            return None
        return float(np.sqrt(np.trace(self.shape_mm2, axis1=1, axis2=2).mean() / 3.0))

    @property
    def epipolar_rms_px(self) -> float | None:
        return None if self.epipolar_px2 is None else float(np.sqrt(self.epipolar_px2.mean()))

    def along(self, k: int, vector: Float) -> float | None:
        length = float(np.linalg.norm(vector))
        if self.shape_mm2 is None or length == 0.0:
            return None
        return float(np.sqrt(max(vector @ self.shape_mm2[k] @ vector, 0.0))) / length

    def epipolar_at(self, k: int) -> float | None:
        return None if self.epipolar_px2 is None else float(np.sqrt(max(self.epipolar_px2[k], 0.0)))


def _roots(a: UncertainPair, b: UncertainPair, shapes: Sequence[Float]) -> tuple[Float, Float] | None:
    """Effect of unit causes on the parameters of both, (n_a, q) and (n_b, q); None without both covariances.

    A column of a shared cause has both. Which of its columns belong together follows from the shapes (3 n, n_a) and
    (3 n, n_b) that the parameters make: the turn of the columns that makes them most alike.
    """
    if a.covariance is None or b.covariance is None:
        return None
    both = [name for name in a.shared if name in b.shared]
    own = [
        _root(
            c.covariance - sum((c.shared[n] @ c.shared[n].T for n in both), np.zeros_like(c.covariance)), c.covariance
        )
        for c in (a, b)
        if c.covariance is not None
    ]
    columns = ([own[0], np.zeros((len(a.names), own[1].shape[1]))], [np.zeros((len(b.names), own[0].shape[1])), own[1]])
    for name in both:
        k = max(a.shared[name].shape[1], b.shared[name].shape[1])
        of_a, of_b = (np.pad(c.shared[name], ((0, 0), (0, k - c.shared[name].shape[1]))) for c in (a, b))
        left, _, right = np.linalg.svd((shapes[1] @ of_b).T @ (shapes[0] @ of_a))
        columns[0].append(of_a)
        columns[1].append(of_b @ left @ right)
    return np.concatenate(columns[0], axis=1), np.concatenate(columns[1], axis=1)


def _root(covariance: Float, whole: Float) -> Float:
    """L (n, q) with L L' a part of the covariance ``whole``."""
    sd = np.sqrt(np.diagonal(whole))
    sd = np.where(sd > 0.0, sd, 1.0)  # px, rad and 1/px^2 in one matrix
    value, vector = np.linalg.eigh(covariance / sd[:, None] / sd)
    return np.asarray(sd[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


def _epipolar_rows(own: UncertainPair, points: Float) -> Float:
    """Derivatives (n, p) of the distance from the epipolar line in camera 2 over the parameters."""
    A = np.concatenate([own.pair.cam1.point_jacobian(points), own.pair.cam2.point_jacobian(points)], axis=-2)
    normal = np.linalg.svd(A)[0][..., 3]  # the one image difference (x1, y1, x2, y2) that no move of the point makes
    normal = normal / np.linalg.norm(normal[:, 2:], axis=1, keepdims=True)
    return np.asarray(np.einsum("ni,nip->np", normal, image_derivatives(own.pair, points, own.names)))


def _measured(pair: StereoPair, images: Float) -> Float:
    """Points (n, 3) nearest to both images in pixels, as the covariance assumes."""
    points = pair.triangulate(images[0], images[1]).xyz_mm
    for _ in range(2):
        A = np.concatenate([pair.cam1.point_jacobian(points), pair.cam2.point_jacobian(points)], axis=-2)
        left = np.concatenate(
            [xy - camera.project(points).xy for xy, camera in zip(images, (pair.cam1, pair.cam2), strict=True)], axis=-1
        )
        At = np.swapaxes(A, 1, 2)
        points = points + np.linalg.solve(At @ A, At @ left[..., None])[..., 0]
    return np.asarray(points)


def _best_motion(a: Float, b: Float) -> RigidTransform:
    """Rigid motion from points ``a`` (n, 3) to ``b``, least squares."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    R = Rotation.align_vectors(b - middle_b, a - middle_a)[0].as_matrix()
    return RigidTransform(R, middle_b - R @ middle_a)


def _motions(points: Float) -> Float:
    """Derivatives (3 n, 7) of points (n, 3) over three shifts, three turns about their middle, and the scale."""
    about = points - points.mean(axis=0)
    out = np.zeros((len(points), 3, 7))
    out[:, range(3), range(3)] = 1.0
    for axis in range(3):
        out[:, :, 3 + axis] = np.cross(np.eye(3)[axis], about)
    out[:, :, 6] = about
    return out.reshape(-1, 7)


def _test(
    a: UncertainPair,
    b: UncertainPair,
    points_mm: Float,
    images: Float,
    b_from_a: RigidTransform,
    roots: tuple[Float, Float] | None,
) -> tuple[float | None, int, float, float | None]:
    """Chi-square of the image differences, its degrees of freedom, the part without any parameter, and the prediction.

    In images the whole difference is seen at once, epipolar offset and shape. Its basis is the space that the
    parameters of the calibration with most of them span, less the motions of the frame.
    """
    moved, left, free = _aligned_in_images(b.pair, points_mm, images, b_from_a)
    spans = []
    for own, points in ((a, points_mm), (b, moved)):
        J = image_derivatives(own.pair, points, own.names).reshape(left.size, -1)
        spans.append(J - free @ (free.T @ J))
    widest = int(len(b.names) >= len(a.names))
    J = spans[widest]
    size = np.linalg.norm(J, axis=0)
    U, s, _ = np.linalg.svd(J / np.where(size > 0.0, size, 1.0), full_matrices=False)
    U = U[:, s > _RANK * s[0]]
    inside = U.T @ left
    outside = float(np.sqrt(np.mean((left - U @ inside) ** 2)))
    if roots is None:
        return None, U.shape[1], outside, None
    D = (U.T @ spans[1]) @ roots[1] - (U.T @ spans[0]) @ roots[0]
    C = D @ D.T
    sd = np.sqrt(np.diagonal(C))
    statistic = inside / sd @ np.linalg.solve(C / np.outer(sd, sd), inside / sd)
    return float(statistic), U.shape[1], outside, float(np.sqrt(np.trace(C) / left.size))


def _aligned_in_images(
    pair: StereoPair, points_mm: Float, images: Float, b_from_a: RigidTransform
) -> tuple[Float, Float, Float]:
    """Move A's points so that B's images of them fit best.

    Returns the points (n, 3), the image differences (4 n,), and an orthonormal basis (4 n, 6) of the changes by
    motions.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    moved = b_from_a.apply(points_mm)

    def at(points: Float) -> tuple[Float, Float]:
        cameras: tuple[Camera, Camera] = (pair.cam1, pair.cam2)
        off = np.concatenate([c.project(points).xy - xy for c, xy in zip(cameras, images, strict=True)], axis=-1)
        A = np.concatenate([c.point_jacobian(points) for c in cameras], axis=-2)
        motions = (A @ _motions(points)[:, :6].reshape(-1, 3, 6)).reshape(-1, 6)
        return off.ravel(), motions

    left, motions = at(moved)
    for _ in range(_ROUNDS):
        step = -np.linalg.lstsq(motions, left, rcond=None)[0]
        middle = moved.mean(axis=0)
        moved = (moved - middle) @ Rotation.from_rotvec(step[3:]).as_matrix().T + middle + step[:3]
        left, motions = at(moved)
    free = np.linalg.qr(motions)[0]
    return moved, left - free @ (free.T @ left), free


def _text(
    shape: Difference, agrees: bool | None, probability: float | None, changes: Changes, shared: tuple[str, ...]
) -> str:
    um = f"{1e3 * shape.value:.3g} um rms of shape"
    if agrees is None or shape.sigma is None:
        return f"They differ by {um}; the uncertainty of one of them is not known, so nothing is concluded."
    predicted = f"{um} where {1e3 * shape.sigma:.3g} um are predicted"
    if shared:
        predicted += f" with the same {' and '.join(shared)} in both"
    if agrees:
        return f"Both calibrations agree: {predicted}, probability of so much {_chance(probability)}."
    return f"The calibrations differ: {predicted}, probability of so much {_chance(probability)}. {changes.text}"


def _chance(probability: float | None) -> str:
    if probability is None:
        return "not known"
    return f"{probability:.2g}" if probability >= _TINY else f"below {_TINY:g}"
