"""Structure left in the residuals of a fit: which term of lens or target would explain it, and how surely.

Each term is a further unknown, held at zero. Its value if it were freed follows from the normal equations at the
minimum (score test), and an F test decides if that is more than chance. Lens terms are tested first, then a smooth
field of fifth degree over the image, which finds structure without a name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.declared import DECLARED, declared_terms
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.fit.layout import camera_of
from stereorig.core.calibration.fit.lens_form import LensName
from stereorig.core.calibration.fit.model import linearise_all
from stereorig.core.calibration.fit.normal import Extra, Normal, assemble, inverse
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.calibration.inputs import NominalValues
from stereorig.core.cameras.lens import LensModel
from stereorig.core.names import CAMERAS
from stereorig.core.robust import f_tail

SIGNIFICANT = 1e-4
#: stretch and shear of the target
UNEQUAL_PITCH = "unequal pitch"
_DEGREE = 5
_LEAST_LEFT = 1e-3
_VARIANCES = 1000
_ROUNDING = 1e-12  # relative, of differences of sums
_MORE = 1.2  # a sheared grid that a stage shows both cameras the same way is a skew of both, and some noise
_LOOSE_WEIGHT = 1e-2**-2  # weight of an aspect ratio's loosest prior; a narrower prior fixes the ratio
_SMOOTH = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i) if i + j >= 2]


@dataclass(frozen=True)
class Freed:
    """Terms of a structure, estimated together with those of all others found.

    Attributes
    ----------
    values
        (q,) posterior means; terms that the views hardly separate from others are small.
    pulled
        (m,) bias of the fit's unknowns because the fit lacks the terms.
    """

    values: Float
    pulled: Float


@dataclass(frozen=True)
class Structure:
    """One group of terms that the residuals ask for.

    Attributes
    ----------
    name
        ``decentring``, ``radial``, ``higher radial``, ``thin prism``, ``higher prism``, ``tilted sensor``, ``aspect``,
        ``skew``, ``bow``, ``unequal pitch``, ``target points``, ``smooth``, or of a declared quantity,
        :mod:`stereorig.core.calibration.choice.declared`.
    camera
        ``cam1`` or ``cam2``; None for the target.
    terms
        Value and standard deviation of each term, by its name.
    probability
        Probability of as large a gain by chance.
    rms_px
        Rms shift of the image points by the terms.
    sentence
        The finding in words of its own; empty for the usual ones.
    freed
        The terms estimated with all structure found; None if they are no unknowns of one fit.
    """

    name: str
    camera: str | None
    terms: dict[str, tuple[float, float]]
    probability: float
    rms_px: float
    sentence: str = ""
    freed: Freed | None = field(default=None, compare=False, repr=False)

    @property
    def text(self) -> str:
        """The finding in one sentence."""
        if self.sentence:
            return self.sentence
        if self.name == "target points":
            sizes = [f"{1e3 * value:.2g} um {key.removesuffix('_mm')}" for key, (value, _) in self.terms.items()]
            return (
                f"The target's points were held as nominal, but all views show them off by about {' and '.join(sizes)} "
                "its plane. Declare node_tolerance_mm (and flatness_mm) to have them corrected."
            )
        who = "the target" if self.camera is None else self.camera
        values = ", ".join(f"{n} = {v:.2g} +- {s:.1g}" for n, (v, s) in self.terms.items())
        what = f"{self.name}: {values}" if values else "a smooth field over the image of no known lens term"
        return f"The residuals of {who} hold structure ({what}), {self.rms_px:.3f} px rms."


@dataclass(frozen=True)
class Unseen:
    """Errors of quantities that the fit took as exact, as far as the views leave room for them.

    Attributes
    ----------
    name
        The group of terms.
    covariance
        (q, q) of the terms after the views.
    pulled
        (m, q) bias of the fit's unknowns by a unit of each term, because the fit lacks it.
    """

    name: str
    covariance: Float
    pulled: Float


@dataclass(frozen=True)
class Group:
    """Terms that are tested together, and their places; ``camera`` is None for terms that both cameras share."""

    name: str
    camera: int | None
    names: tuple[str, ...]
    columns: NDArray[np.intp]


_PRISM, _ASPECT, _SKEW = ("thin prism", ("s1", "s3")), ("aspect", ("aspect",)), ("skew", ("skew",))
_HIGHER, _HIGHER_PRISM = ("higher radial", ("r8", "r10")), ("higher prism", ("s2", "s4"))
#: groups of lens terms that a model lacks
_LENS_GROUPS: dict[LensName, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "paper": (("decentring", ("p1", "p2")), ("radial", ("k2", "k3")), _PRISM, _ASPECT, _SKEW),
    "opencv5": (_HIGHER, _PRISM, _ASPECT, _SKEW),
    "opencv8": (_PRISM, _ASPECT, _SKEW),
    "opencv5_prism": (_HIGHER, _HIGHER_PRISM, _ASPECT, _SKEW),
    "opencv5_tilted": (_HIGHER, _PRISM, _ASPECT, _SKEW),
    "opencv5_prism_tilted": (_HIGHER, _HIGHER_PRISM, _ASPECT, _SKEW),
    "opencv12": (_ASPECT, _SKEW),
    "opencv14": (_ASPECT, _SKEW),
}
# to first order a homography, most of which decentring, pose and centre take up; to second order a skew, which no
# sensor's pixels have
_TILT = ("tilted sensor", ("tau_x_rad", "tau_y_rad", "skew"))
#: of the groups above, those that the next model would take up
LENS_TERMS = ("decentring", "radial", "higher radial")


def _lens_term(name: str, n: Float, focal_px: float) -> Float:
    x, y = n[:, 0], n[:, 1]
    r2 = x * x + y * y
    zero = np.zeros_like(x)
    if name in ("k2", "k3", "r8", "r10"):
        power = {"k2": 2, "k3": 3, "r8": 4, "r10": 5}[name]
        return focal_px * n * (r2**power)[:, None]
    fields = {
        "p1": (2.0 * x * y, r2 + 2.0 * y * y),
        "p2": (r2 + 2.0 * x * x, 2.0 * x * y),
        "s1": (r2, zero),
        "s3": (zero, r2),
        "s2": (r2 * r2, zero),
        "s4": (zero, r2 * r2),
        "aspect": (zero, y),
        "skew": (y, zero),
        "tau_x_rad": (x * y, y * y),
        "tau_y_rad": (-x * x, -x * y),
    }
    return focal_px * np.stack(fields[name], axis=-1)


def image_fields(found: Structure, lens: LensModel, normalised: Float, size_px: tuple[int, int]) -> Float:
    """Return the shift of a camera's images (n, 2) at depth 1 for a unit of each term of a structure, (n, 2, q)."""
    if found.name == "smooth":
        return _smooth(lens.image_from_normalised(normalised).xy, size_px)
    focal_px = lens.kernel_parameters()[1]
    return np.stack([_lens_term(name, normalised, focal_px) for name in found.terms], axis=-1)


def _smooth(xy_px: Float, size_px: tuple[int, int]) -> Float:
    """Products of Legendre polynomials over the image, (n, 2, 2 terms)."""
    u = np.clip(2.0 * (xy_px + 0.5) / np.array(size_px) - 1.0, -1.0, 1.0)
    px, py = (legendre.legvander(u[:, k], _DEGREE) for k in range(2))
    values = np.stack([px[:, i] * py[:, j] for i, j in _SMOOTH], axis=-1)
    out = np.zeros((len(xy_px), 2, 2 * values.shape[1]))
    out[:, 0, : values.shape[1]] = values
    out[:, 1, values.shape[1] :] = values
    return out


def find_structure(groups: Sequence[Group], score: Score, given: Sequence[Group] = ()) -> list[Structure]:
    """Return the structure in the residuals beyond noise and declared quantities, most certain first.

    Parameters
    ----------
    groups, score
        See :func:`scored`.
    given
        Groups that are known to be there.
    """
    others = [g for g in groups if g.name not in DECLARED]
    named, smooth = [g for g in others if g.name != "smooth"], [g for g in others if g.name == "smooth"]
    accepted = list(given)
    found: list[Structure] = []
    weights: list[Float] = []
    for candidates in (named, smooth):
        left = list(candidates)
        while left:
            tests = [(score.test(g, accepted), g) for g in left]
            best, group = min(tests, key=lambda t: (t[0].probability, -t[0].rms_px))
            if not best.probability < SIGNIFICANT:
                break
            found.append(best)
            weights.append(score.weights(group, accepted))
            accepted.append(group)
            left.remove(group)
    freed = score.freed(accepted[len(given) :], weights, given)
    return [replace(one, freed=terms) for one, terms in zip(found, freed, strict=True)]


def lens_significance(
    groups: Sequence[Group], score: Score, given: Sequence[Group] = (), names: Sequence[str] = LENS_TERMS
) -> tuple[float, Structure]:
    """Return the probability that chance explains as much as the next lens model's terms, the smaller of both cameras'.

    Parameters
    ----------
    groups, score, given
        As of :func:`find_structure`.
    names
        Names of the terms' groups.

    Returns
    -------
    probability, structure
        The smallest of the groups' (each times the number of groups), and that group.
    """
    tests = [score.test(g, given) for g in groups if g.name in names]
    joint = [score.test(g, given) for g in joint_terms(groups)] if names is LENS_TERMS else []
    best = min([*tests, *joint], key=lambda s: s.probability)
    return min(1.0, best.probability * len(tests)), best


def lens_share_px(groups: Sequence[Group], score: Score) -> float:
    """Rms shift of both cameras' image points by all terms of the next lens model; 0 without any."""
    moved = [score.test(g, []).rms_px ** 2 for g in joint_terms(groups)]
    return float(np.sqrt(np.mean(moved))) if moved else 0.0


def joint_terms(groups: Sequence[Group]) -> list[Group]:
    """Return all terms of the next lens model, one group for each camera."""
    out = []
    for c in range(2):
        own = [g for g in groups if g.name in LENS_TERMS and g.camera == c]
        if not own:
            continue
        names = tuple(n for g in own for n in g.names)
        out.append(Group("+".join(g.name for g in own), c, names, np.concatenate([g.columns for g in own])))
    return out


def no_target(groups: Sequence[Group], score: Score, found: Structure, *, staged: bool) -> bool:
    """Return True if a term of both lenses explains more than errors of the target or declared quantities do."""

    def squares(group: Group) -> float:
        return score.test(group, []).rms_px ** 2 * score.points([0, 1] if group.camera is None else [group.camera])

    by_lenses = sum(squares(g) for g in groups if g.name == found.name) / (_MORE if staged else 1.0)
    rivals = [g for g in groups if g.name in ("bow", UNEQUAL_PITCH, *DECLARED)]
    return not any(score.test(g, []).probability <= found.probability and squares(g) > by_lenses for g in rivals)


def scored(
    adjustment: Adjustment,
    views: Sequence[ViewRows],
    nominal_nodes_mm: Float,
    nominals: Sequence[NominalValues],
    *,
    tilted: bool = False,
) -> tuple[list[Group], Score]:
    """Return the groups of terms that may be tested, and their score tests at a minimum.

    Parameters
    ----------
    adjustment
        The minimum.
    views, nominal_nodes_mm, nominals
        The views, nominal points and nominal cameras of the fit.
    tilted
        True tests a tilted sensor as well.
    """
    groups, extras, n_extra = _extras(adjustment, views, nominal_nodes_mm, nominals, tilted=tilted)
    normal = assemble(
        adjustment.layout,
        adjustment.state,
        views,
        nominal_nodes_mm,
        adjustment.priors,
        adjustment.noise_px,
        extras=extras,
        n_extra=n_extra,
    )
    return groups, Score(normal, adjustment, [sum(v.count for v in views if v.camera == c) for c in range(2)])


def _extras(
    adjustment: Adjustment,
    views: Sequence[ViewRows],
    nominal_nodes_mm: Float,
    nominals: Sequence[NominalValues],
    *,
    tilted: bool,
) -> tuple[list[Group], list[Extra], int]:
    layout, state = adjustment.layout, adjustment.state
    first = layout.size
    groups: list[Group] = []
    at = first
    per_camera: list[list[str]] = [[], []]
    starts = [0, 0]
    for c, name in enumerate(CAMERAS):
        del name
        starts[c] = at
        for label, terms in (*_LENS_GROUPS[layout.form.model], *([_TILT] if tilted else [])):
            if label == "aspect" and _loose(adjustment, layout.lens(c).stop - 1):
                continue
            groups.append(Group(label, c, terms, np.arange(at, at + len(terms))))
            per_camera[c].extend(terms)
            at += len(terms)
        groups.append(Group("smooth", c, (), np.arange(at, at + 2 * len(_SMOOTH))))
        at += 2 * len(_SMOOTH)
    board = adjustment.priors.nodes_free == 0
    board_at = at
    if board:
        groups.append(Group("bow", None, ("XX_mm", "XY_mm", "YY_mm"), np.arange(at, at + 3)))
        groups.append(Group(UNEQUAL_PITCH, None, ("stretch", "shear"), np.arange(at + 3, at + 5)))
        at += 5
    half = np.abs(nominal_nodes_mm[:, :2]).max()
    X, Y = (nominal_nodes_mm[:, :2] / half).T
    lins = linearise_all(layout, state, views, nominal_nodes_mm)
    declared = declared_terms(adjustment, views, lins, nominal_nodes_mm, at)
    groups.extend(Group(label, None, terms, own) for label, terms, own in declared.groups)
    extras = []
    for k, (view, lin) in enumerate(zip(views, lins, strict=True)):
        c = view.camera
        values = state.x[layout.lens(c)]
        size = nominals[c].image_size_px
        fields = [_lens_term(t, lin.normalised, float(values[0])) for t in per_camera[c]]
        image = camera_of(layout, state.x, c).lens.image_from_normalised(lin.normalised).xy
        smooth = _smooth(np.where(view.found[:, None], image, 0.0), size)
        parts = [np.stack(fields, axis=-1), smooth]
        columns = [np.arange(starts[c], starts[c] + len(fields) + smooth.shape[-1])]
        if board:
            B = lin.by_node
            bow = B[:, :, 2, None] * np.stack([X * X, X * Y, Y * Y], axis=-1)[:, None, :]
            stretch = np.stack([B[:, :, 0] * (X * half)[:, None], B[:, :, 0] * (Y * half)[:, None]], axis=-1)
            parts.extend([bow, stretch])
            columns.append(np.arange(board_at, board_at + 5))
        extra = np.concatenate(parts, axis=-1)
        extra[~view.found] = 0.0
        extras.append(
            Extra(np.concatenate([*columns, declared.columns[k]]), np.concatenate([extra, declared.values[k]], axis=-1))
        )
    return groups, extras, at + declared.count - first


def _loose(adjustment: Adjustment, place: int) -> bool:
    """Return True if only the views determine an unknown."""
    priors = adjustment.priors
    return bool(priors.free[place] and priors.weight[place] < _LOOSE_WEIGHT)


class Score:
    """Score tests on one set of normal equations."""

    def __init__(self, normal: Normal, adjustment: Adjustment, counts: Sequence[int]) -> None:
        S, g, _ = normal.reduced()
        free = normal.free
        C = inverse(S[np.ix_(free, free)])
        E = np.arange(len(free)) >= adjustment.layout.size
        cross = S[np.ix_(E, free)]
        self._pulls = np.zeros((adjustment.layout.size, int(E.sum())))
        self._pulls[np.flatnonzero(free)] = C @ cross.T
        self._first = adjustment.layout.size
        self._matrix = S[np.ix_(E, E)] - cross @ C @ cross.T
        # for a term that the fit or the freed groups can produce, only rounding is left
        self._rounding = _ROUNDING * np.diagonal(S)[E]
        self._right = g[E] - cross @ (C @ g[free])
        self._redundancy = adjustment.redundancy
        self._noise = adjustment.noise_px
        self._counts = counts

    def points(self, cameras: Sequence[int]) -> float:
        """Return how many image points some cameras have."""
        return float(sum(self._counts[c] for c in cameras))

    def chance_px(self, group: Group) -> float:
        """Rms shift of the image points by a group's terms if the residuals are noise."""
        cameras = [group.camera] if group.camera is not None else [0, 1]
        count = self.points(cameras)
        return float(np.mean([self._noise[c] for c in cameras]) * np.sqrt(len(group.columns) / max(count, 1.0)))

    def test(self, group: Group, given: Sequence[Group]) -> Structure:
        """Test one group with others freed too."""
        own = group.columns - self._first
        M, r, base = self._left([group], given)
        left_over = np.diagonal(M)
        unseen = left_over <= self._rounding[own]
        scale = 1.0 / np.sqrt(np.maximum(np.where(unseen, self._rounding[own], left_over), 1e-300))
        variance = scale**2
        scale[unseen] = 0.0
        values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
        shown = values > 1e-9 * max(float(values[-1]), 1e-300)
        half = (vectors[:, shown] / np.sqrt(values[shown])) * scale[:, None]
        C = half @ half.T
        estimate = C @ r
        gain = float(r @ estimate)
        q = int(shown.sum())
        cameras = [group.camera] if group.camera is not None else [0, 1]
        redundancy = float(sum(self._redundancy[c] for c in cameras))
        # linear to first order: large residuals keep at least a part of their squares after a term is taken out
        left = max(redundancy - base - gain, _LEAST_LEFT * redundancy)
        freedom = max(redundancy - q, 1.0)
        statistic = (gain / q) / (left / freedom) if q else 0.0
        probability = f_tail(statistic, q, freedom) if q else 1.0
        sigma = np.sqrt(np.where(unseen, variance, np.diagonal(C))) * np.sqrt(left / freedom)
        noise = float(np.mean([self._noise[c] for c in cameras]))
        count = self.points(cameras)
        terms = {n: (float(v), float(s)) for n, v, s in zip(group.names, estimate, sigma, strict=False)}
        name = None if group.camera is None else CAMERAS[group.camera]
        if group.name == "smooth":
            gain -= q * left / freedom  # its many terms take up as much of mere noise
        return Structure(group.name, name, terms, probability, noise * float(np.sqrt(max(gain, 0.0) / max(count, 1.0))))

    def hidden(self, group: Group, sigma: float) -> Unseen:
        """Return how far terms with a prior standard deviation may be off without these views showing it."""
        own = group.columns - self._first
        left = inverse(self._matrix[np.ix_(own, own)] + np.eye(len(own)) / sigma**2)
        return Unseen(group.name, left, self._pulls[:, own])

    def spread(self, group: Group, given: Sequence[Group]) -> float:
        """Return the most likely standard deviation of a group's terms, if all are drawn from one distribution.

        Terms of which the views show only some combinations are uncertain by many times as much.
        """
        M, r, _ = self._left([group], given)
        values, vectors = np.linalg.eigh(M)
        shown = values > 1e-9 * max(float(values[-1]), 1e-300)
        m, squares = values[shown], (vectors[:, shown].T @ r) ** 2
        variance = np.geomspace(1e-6, 1e6, _VARIANCES) * float(np.max(squares / m**2, initial=1e-300))
        gain = 1.0 + m * variance[:, None]
        likelihood = np.sum(squares * variance[:, None] / gain - np.log(gain), axis=1)
        return float(np.sqrt(variance[np.argmax(likelihood)]))

    def weights(self, group: Group, given: Sequence[Group]) -> Float:
        """Return prior weights (q,) of terms: each alone is as large as the group's gain beyond the others."""
        M, r, _ = self._left([group], given)
        q = len(r)
        gain = float(r @ np.linalg.pinv(M, rcond=1e-9, hermitian=True) @ r)
        alone = np.diagonal(self._left([group], ())[0])
        return np.asarray(np.maximum(alone, 1e-300) * q / max(gain - q, 0.1 * q))

    def freed(self, groups: Sequence[Group], weights: Sequence[Float], given: Sequence[Group]) -> list[Freed]:
        """Return the terms of groups as they are expected together, by their prior weights."""
        if not groups:
            return []
        M, r, _ = self._left(groups, given)
        estimate = np.linalg.solve(M + np.diag(np.concatenate(weights)), r)
        parts = np.split(estimate, np.cumsum([len(g.columns) for g in groups])[:-1])
        return [Freed(e, self._pulls[:, g.columns - self._first] @ e) for e, g in zip(parts, groups, strict=True)]

    def _left(self, groups: Sequence[Group], given: Sequence[Group]) -> tuple[Float, Float, float]:
        """Return matrix and right-hand side of some groups' terms with others freed, and the gain by the others."""
        own, others = (
            np.concatenate([np.zeros(0, dtype=np.intp), *(g.columns - self._first for g in part)]).astype(np.intp)
            for part in (groups, given)
        )
        M, r = self._matrix[np.ix_(own, own)], self._right[own]
        if not others.size:
            return M, r, 0.0
        K = np.linalg.pinv(self._matrix[np.ix_(others, others)], rcond=1e-10, hermitian=True)
        cross = self._matrix[np.ix_(own, others)]
        right = self._right[others]
        return M - cross @ K @ cross.T, r - cross @ (K @ right), float(right @ K @ right)
