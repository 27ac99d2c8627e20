"""Cause of the difference of two calibrations of one rig: a moved camera, a turned lens, another pitch of the target.

The frame is no part of a camera: the comparison takes each lens's parameters and the pose of camera 2 from camera 1.
Each cause is a group of these numbers. A cause explains the difference if the others, with all correlations and any
change in the group, differ by no more than their covariance predicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import POSE_NAMES, Camera, angles_from_rotation, rotation_derivatives
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from stereorig.core.robust import chi_square_tail

Cause = Literal["scale", "camera_moved", "focal_length", "image_centre", "distortion", "lens"]
_FOCAL = ("phd_px", "fx_px", "fy_px")
_CENTRE = ("cx_px", "cy_px")


@dataclass(frozen=True)
class CameraChange:
    """A difference of the cameras, B minus A.

    Attributes
    ----------
    name
        Name of the number, its unit at the end.
    value, sigma
        The difference, and its standard deviation; None if that is not known.
    """

    name: str
    value: float
    sigma: float | None


@dataclass(frozen=True)
class Explanation:
    """A cause, its camera (None: both, or their relative pose), and the test of the remaining numbers.

    Attributes
    ----------
    cause, camera
        The cause.
    chi_square, degrees, probability
        Test of the other numbers.
    """

    cause: Cause
    camera: str | None
    chi_square: float
    degrees: int
    probability: float


@dataclass(frozen=True)
class Changes:
    """Differences of the cameras and their likely cause.

    Attributes
    ----------
    numbers
        Scale, turn of camera 2 against camera 1, baseline, focal lengths, image centres.
    explanations
        All causes, the likeliest first; empty if covariances are missing or lens models differ.
    explained
        True if the first explains the whole difference.
    text
        The cause in one sentence.
    """

    numbers: tuple[CameraChange, ...]
    explanations: tuple[Explanation, ...]
    explained: bool
    text: str


def find_changes(
    a: StereoPair,
    b: StereoPair,
    names: tuple[Sequence[str], Sequence[str]],
    roots: tuple[Float, Float] | None,
    *,
    scale: tuple[float, float | None],
    significant: float,
) -> Changes:
    """Find which change of the cameras explains the difference of two calibrations.

    Parameters
    ----------
    a, b
        The pairs.
    names
        Names of the estimated parameters of each.
    roots
        (n_a, q) and (n_b, q) effect of unit causes on them; None if a covariance is not known.
    scale
        Relative difference of size in the common volume, and its standard deviation.
    significant
        Probability below which a cause is refused.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    lenses = [[n for n in own if n.partition(".")[2] not in POSE_NAMES] for own in names]
    same_lens = lenses[0] == lenses[1]
    shown = lenses[0] if same_lens else [n for n in lenses[0] if n in lenses[1]]
    relative = [_relative(pair) for pair in (a, b)]
    values = [pair.values() for pair in (a, b)]
    turn = Rotation.from_matrix(relative[1][0] @ relative[0][0].T).as_rotvec()
    shift = relative[1][1] - relative[0][1]
    delta = np.concatenate([[values[1][n] - values[0][n] for n in shown], turn, shift])
    covariance = None
    if roots is not None:
        J_a, J_b = (_derivatives(pair, shown, own) for pair, own in zip((a, b), names, strict=True))
        D = J_b @ roots[1] - J_a @ roots[0]
        covariance = D @ D.T
    baseline = relative[0][1] / np.linalg.norm(relative[0][1])
    size = CameraChange("scale_ppm", 1e6 * scale[0], None if scale[1] is None else 1e6 * scale[1])
    numbers = (size, *_numbers(shown, delta, covariance, baseline))
    if covariance is None:
        return Changes(numbers, (), explained=False, text=_largest(numbers))
    if not same_lens:
        return Changes(numbers, (), explained=False, text=f"Their lens models differ. {_largest(numbers)}")
    explanations = _explanations(shown, values[0], delta, covariance, relative[0][1])
    possible = [e for e in explanations if e.probability >= significant]
    if possible:
        # the fewest numbers first: the groups come in that order, and a cause that is likely before one that is not
        first = possible[0]
        ordered = [*possible, *sorted((e for e in explanations if e not in possible), key=_left)]
    else:
        ordered = sorted(explanations, key=_left)
        first = ordered[0]
    others = [e for e in possible if e is not first and not _contains(e, first)]
    text = _sentence(first, numbers, explained=bool(possible))
    if others:
        text += f" As well possible: {', '.join(_named(e) for e in others)}."
    return Changes(numbers, tuple(ordered), explained=bool(possible), text=text)


def _relative(pair: StereoPair) -> tuple[Float, Float]:
    pose = pair.cam2_from_cam1
    return pose.rotation, pose.translation_mm


def _left(explanation: Explanation) -> float:
    return explanation.chi_square / max(explanation.degrees, 1)


def _contains(e: Explanation, first: Explanation) -> bool:
    """Return True if a cause is the first one with more freedom."""
    return (e.cause == "lens" and e.camera == first.camera) or (e.cause == "camera_moved" and first.cause == "scale")


def _derivatives(pair: StereoPair, shown: Sequence[str], names: Sequence[str]) -> Float:
    """Derivatives of the lens parameters shown and of the relative pose (turn, shift) over the named parameters."""
    column = {name: k for k, name in enumerate(names)}
    J = np.zeros((len(shown) + 6, len(names)))
    for row, name in enumerate(shown):
        J[row, column[name]] = 1.0
    R, _ = _relative(pair)
    t1 = pair.cam1.cam_from_sys.translation_mm
    turn, shift = slice(len(shown), len(shown) + 3), slice(len(shown) + 3, len(shown) + 6)
    for c, camera in enumerate((pair.cam1, pair.cam2)):
        own = [column[f"{CAMERAS[c]}.{name}"] for name in POSE_NAMES]
        spins = _spins(camera)
        turned = spins if c else -R @ spins
        J[turn, own[:3]] = turned
        J[shift, own[:3]] = -np.cross(turned, R @ t1, axis=0)
        J[shift, own[3:]] = np.eye(3) if c else -R
    return J


def _spins(camera: Camera) -> Float:
    """Turns (3, 3) of a camera's pose, rotation vectors in its frame, over alpha, beta, gamma: one a column."""
    R = camera.cam_from_sys.rotation
    columns = []
    for dR in rotation_derivatives(*angles_from_rotation(R)):
        W = dR @ R.T
        columns.append([W[2, 1], W[0, 2], W[1, 0]])
    return np.array(columns).T


def _numbers(shown: Sequence[str], delta: Float, covariance: Float | None, baseline: Float) -> tuple[CameraChange, ...]:
    turn, shift = delta[-6:-3], delta[-3:]
    size = float(np.linalg.norm(turn))
    rows: list[tuple[str, Float, float]] = []
    row = np.zeros(len(delta))
    row[-6:-3] = np.degrees(turn / size) if size > 0.0 else 0.0
    rows.append(("relative_orientation_deg", row, float(np.degrees(size))))
    row = np.zeros(len(delta))
    row[-3:] = baseline
    rows.append(("baseline_mm", row, float(baseline @ shift)))
    for k, name in enumerate(shown):
        if name.partition(".")[2] in (*_FOCAL, *_CENTRE):
            rows.append((name, np.eye(len(delta))[k], float(delta[k])))
    out = []
    for name, row, value in rows:
        sigma = None if covariance is None else float(np.sqrt(max(float(row @ covariance @ row), 0.0)))
        out.append(CameraChange(name, value, sigma))
    return tuple(out)


def _explanations(
    shown: Sequence[str], values: dict[str, float], delta: Float, covariance: Float, translation: Float
) -> list[Explanation]:
    """Test each group of numbers; groups of few numbers and frequent causes first."""
    size = len(delta)

    def unit(indices: Sequence[int]) -> Float:
        return np.eye(size)[:, list(indices)]

    def of(camera: str, wanted: Sequence[str] | None = None) -> list[int]:
        own = [(k, *n.partition(".")[::2]) for k, n in enumerate(shown)]
        return [k for k, cam, n in own if cam == camera and (wanted is None or n in wanted)]

    scale = np.zeros((size, 1))
    scale[-3:, 0] = translation
    groups: list[tuple[Cause, str | None, Float]] = [("scale", None, scale)]
    for camera in CAMERAS:
        focal = np.zeros((size, 1))
        for k in of(camera, _FOCAL):
            focal[k, 0] = values[shown[k]]
        groups.append(("focal_length", camera, focal))
    groups.append(("camera_moved", None, unit(range(size - 6, size))))
    groups += [("image_centre", camera, unit(of(camera, _CENTRE))) for camera in CAMERAS]
    for camera in CAMERAS:
        bent = [k for k in of(camera) if k not in of(camera, (*_FOCAL, *_CENTRE))]
        groups.append(("distortion", camera, unit(bent)))
    groups += [("lens", camera, unit(of(camera))) for camera in CAMERAS]
    sd = np.sqrt(np.diagonal(covariance))
    L = np.linalg.cholesky(covariance / np.outer(sd, sd))
    white = np.linalg.solve(L, delta / sd)
    out = []
    for cause, camera_or_none, group in groups:
        if not group.any():
            continue
        made = np.linalg.qr(np.linalg.solve(L, group / sd[:, None]))[0]
        left = white - made @ (made.T @ white)
        statistic, degrees = float(left @ left), size - made.shape[1]
        out.append(Explanation(cause, camera_or_none, statistic, degrees, chi_square_tail(statistic, degrees)))
    return out


def _named(e: Explanation) -> str:
    words = {
        "scale": "another scale",
        "camera_moved": "a camera that moved",
        "focal_length": f"another focal length of {e.camera}",
        "image_centre": f"another image centre of {e.camera}",
        "distortion": f"another distortion of {e.camera}",
        "lens": f"another lens setting of {e.camera}",
    }
    return words[e.cause]


def _shown(change: CameraChange) -> str:
    sigma = "" if change.sigma is None else f" +- {change.sigma:.2g}"
    return f"{change.name} {change.value:+.4g}{sigma}"


def _sentence(e: Explanation, numbers: Sequence[CameraChange], *, explained: bool) -> str:
    wanted: dict[Cause, tuple[str, ...]] = {
        "scale": ("scale_ppm",),
        "camera_moved": ("relative_orientation_deg", "baseline_mm"),
        "focal_length": _FOCAL,
        "image_centre": _CENTRE,
        "distortion": (),
        "lens": (*_FOCAL, *_CENTRE),
    }
    own = [
        n
        for n in numbers
        if n.name.rpartition(".")[2] in wanted[e.cause] and (e.camera is None or n.name.startswith(f"{e.camera}."))
    ]
    part = f" ({', '.join(_shown(n) for n in own)})" if own else ""
    if explained:
        return f"It is explained by {_named(e)}{part}."
    return f"No single change explains it; nearest comes {_named(e)}{part}."


def _largest(numbers: Sequence[CameraChange]) -> str:
    """Sentence on the number that differs most in units of its standard deviation."""
    known = [n for n in numbers if n.sigma]
    if not known:
        return f"Of the cameras, {_shown(numbers[1])}, {_shown(numbers[2])}."
    most = max(known, key=lambda n: abs(n.value) / (n.sigma or 1.0))
    return f"Most of all differs {_shown(most)}."
