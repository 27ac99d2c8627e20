"""Structure left in the residuals of a fit: which term of lens or target would explain it, and how surely.

Each term is a further unknown, held at zero. From the normal equations at the minimum follows what it would come out
as if it were freed (score test), and by an F test if that is more than chance. Lens terms are asked first, then a
smooth field of fifth degree over the image, which finds what has no name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from core.arrays import Float
from core.calibration.fit.adjust import Adjustment
from core.calibration.fit.layout import camera_of
from core.calibration.fit.lens_form import LensName
from core.calibration.fit.model import linearise_all
from core.calibration.fit.normal import Extra, Normal, assemble, inverse
from core.calibration.fit.observations import ViewRows
from core.calibration.inputs import NominalCamera
from core.names import CAMERAS
from core.significance import f_tail

SIGNIFICANT = 1e-4
_DEGREE = 5
_LEAST_LEFT = 1e-3
_SMOOTH = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i) if i + j >= 2]


@dataclass(frozen=True)
class Structure:
    """One group of terms that the residuals ask for.

    Attributes
    ----------
    name
        ``decentring``, ``radial``, ``higher radial``, ``thin prism``, ``aspect``, ``skew``, ``bow``, ``unequal
        pitch``, ``target points`` or ``smooth``.
    camera
        ``cam1`` or ``cam2``; None for the target.
    terms
        Value and standard deviation of each term, by its name.
    probability
        Of as much by chance.
    rms_px
        What the terms move the image points by.
    """

    name: str
    camera: str | None
    terms: dict[str, tuple[float, float]]
    probability: float
    rms_px: float

    @property
    def text(self) -> str:
        """The finding in one sentence."""
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
class _Group:
    name: str
    camera: int | None
    names: tuple[str, ...]
    columns: NDArray[np.intp]


#: groups of lens terms that a model lacks
_LENS_GROUPS: dict[LensName, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "paper": (
        ("decentring", ("p1", "p2")),
        ("radial", ("k2", "k3")),
        ("thin prism", ("s1", "s3")),
        ("aspect", ("aspect",)),
        ("skew", ("skew",)),
    ),
    "opencv5": (
        ("higher radial", ("r8", "r10")),
        ("thin prism", ("s1", "s3")),
        ("aspect", ("aspect",)),
        ("skew", ("skew",)),
    ),
    "opencv8": (("thin prism", ("s1", "s3")), ("aspect", ("aspect",)), ("skew", ("skew",))),
}
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
        "aspect": (zero, y),
        "skew": (y, zero),
    }
    return focal_px * np.stack(fields[name], axis=-1)


def _smooth(xy_px: Float, size_px: tuple[int, int]) -> Float:
    """Products of Legendre polynomials over the image, (n, 2, 2 terms)."""
    u = np.clip(2.0 * (xy_px + 0.5) / np.array(size_px) - 1.0, -1.0, 1.0)
    px, py = (legendre.legvander(u[:, k], _DEGREE) for k in range(2))
    values = np.stack([px[:, i] * py[:, j] for i, j in _SMOOTH], axis=-1)
    out = np.zeros((len(xy_px), 2, 2 * values.shape[1]))
    out[:, 0, : values.shape[1]] = values
    out[:, 1, values.shape[1] :] = values
    return out


def find_structure(
    adjustment: Adjustment, views: Sequence[ViewRows], nominal_nodes_mm: Float, nominals: Sequence[NominalCamera]
) -> list[Structure]:
    """Return what the residuals hold beyond noise, most certain first.

    Parameters
    ----------
    adjustment
        The minimum.
    views, nominal_nodes_mm, nominals
        As it was fitted to.
    """
    groups, score = _scored(adjustment, views, nominal_nodes_mm, nominals)
    named, smooth = [g for g in groups if g.name != "smooth"], [g for g in groups if g.name == "smooth"]
    accepted: list[_Group] = []
    found: list[Structure] = []
    for candidates in (named, smooth):
        left = list(candidates)
        while left:
            tests = [(score.test(g, accepted), g) for g in left]
            best, group = min(tests, key=lambda t: t[0].probability)
            if not best.probability < SIGNIFICANT:
                break
            found.append(best)
            accepted.append(group)
            left.remove(group)
    return found


def lens_significance(
    adjustment: Adjustment, views: Sequence[ViewRows], nominal_nodes_mm: Float, nominals: Sequence[NominalCamera]
) -> tuple[float, Structure]:
    """Probability of what the next lens model's terms would explain by chance, the smaller of both cameras'.

    Returns
    -------
    probability, structure
        The smallest of the groups' (each times the number of groups), and that group.
    """
    groups, score = _scored(adjustment, views, nominal_nodes_mm, nominals)
    chosen = [g for g in groups if g.name in LENS_TERMS]
    tests = [score.test(g, []) for g in chosen]
    joint = [
        score.test(
            _Group(
                "+".join(g.name for g in chosen if g.camera == c),
                c,
                tuple(n for g in chosen if g.camera == c for n in g.names),
                np.concatenate([g.columns for g in chosen if g.camera == c]),
            ),
            [],
        )
        for c in range(2)
    ]
    best = min([*tests, *joint], key=lambda s: s.probability)
    return min(1.0, best.probability * len(tests)), best


def _scored(
    adjustment: Adjustment, views: Sequence[ViewRows], nominal_nodes_mm: Float, nominals: Sequence[NominalCamera]
) -> tuple[list[_Group], _Score]:
    """Groups of terms that may be asked for, and their score tests at the minimum."""
    groups, extras, n_extra = _extras(adjustment, views, nominal_nodes_mm, nominals)
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
    return groups, _Score(normal, adjustment, [sum(v.count for v in views if v.camera == c) for c in range(2)])


def _extras(
    adjustment: Adjustment, views: Sequence[ViewRows], nominal_nodes_mm: Float, nominals: Sequence[NominalCamera]
) -> tuple[list[_Group], list[Extra], int]:
    layout, state = adjustment.layout, adjustment.state
    first = layout.size
    groups: list[_Group] = []
    at = first
    per_camera: list[list[str]] = [[], []]
    starts = [0, 0]
    for c, name in enumerate(CAMERAS):
        del name
        starts[c] = at
        for label, terms in _LENS_GROUPS[layout.form.model]:
            if label == "aspect" and adjustment.priors.free[layout.lens(c)][layout.form.aspect_index]:
                continue
            groups.append(_Group(label, c, terms, np.arange(at, at + len(terms))))
            per_camera[c].extend(terms)
            at += len(terms)
        groups.append(_Group("smooth", c, (), np.arange(at, at + 2 * len(_SMOOTH))))
        at += 2 * len(_SMOOTH)
    board = adjustment.priors.nodes_free == 0
    board_at = at
    if board:
        groups.append(_Group("bow", None, ("XX_mm", "XY_mm", "YY_mm"), np.arange(at, at + 3)))
        groups.append(_Group("unequal pitch", None, ("stretch", "shear"), np.arange(at + 3, at + 5)))
        at += 5
    half = np.abs(nominal_nodes_mm[:, :2]).max()
    X, Y = (nominal_nodes_mm[:, :2] / half).T
    extras = []
    for view, lin in zip(views, linearise_all(layout, state, views, nominal_nodes_mm), strict=True):
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
        extras.append(Extra(np.concatenate(columns), extra))
    return groups, extras, at - first


class _Score:
    """Score tests on one set of normal equations."""

    def __init__(self, normal: Normal, adjustment: Adjustment, counts: Sequence[int]) -> None:
        S, g, _ = normal.reduced()
        free = normal.free
        C = inverse(S[np.ix_(free, free)])
        E = np.arange(len(free)) >= adjustment.layout.size
        cross = S[np.ix_(E, free)]
        self._first = adjustment.layout.size
        self._matrix = S[np.ix_(E, E)] - cross @ C @ cross.T
        self._right = g[E] - cross @ (C @ g[free])
        self._redundancy = adjustment.redundancy
        self._noise = adjustment.noise_px
        self._counts = counts

    def test(self, group: _Group, given: Sequence[_Group]) -> Structure:
        """Test one group with others freed too."""
        own = group.columns - self._first
        others = np.concatenate([g.columns for g in given] or [np.zeros(0, dtype=np.intp)]) - self._first
        others = others.astype(np.intp)
        M, r = self._matrix[np.ix_(own, own)], self._right[own]
        base = 0.0
        if others.size:
            K = np.linalg.pinv(self._matrix[np.ix_(others, others)], rcond=1e-10, hermitian=True)
            cross = self._matrix[np.ix_(own, others)]
            M = M - cross @ K @ cross.T
            r = r - cross @ (K @ self._right[others])
            base = float(self._right[others] @ K @ self._right[others])
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(M), 1e-300))
        values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
        shown = values > 1e-9 * max(float(values[-1]), 1e-300)
        half = (vectors[:, shown] / np.sqrt(values[shown])) * scale[:, None]
        C = half @ half.T
        estimate = C @ r
        gain = float(r @ estimate)
        q = int(shown.sum())
        cameras = [group.camera] if group.camera is not None else [0, 1]
        redundancy = float(sum(self._redundancy[c] for c in cameras))
        # linear to first order: what a term explains of large residuals leaves no less than a part of them
        left = max(redundancy - base - gain, _LEAST_LEFT * redundancy)
        freedom = max(redundancy - q, 1.0)
        statistic = (gain / q) / (left / freedom) if q else 0.0
        probability = f_tail(statistic, q, freedom) if q else 1.0
        sigma = np.sqrt(np.diagonal(C)) * np.sqrt(left / freedom)
        noise = float(np.mean([self._noise[c] for c in cameras]))
        count = float(sum(self._counts[c] for c in cameras))
        terms = {n: (float(v), float(s)) for n, v, s in zip(group.names, estimate, sigma, strict=False)}
        name = None if group.camera is None else CAMERAS[group.camera]
        return Structure(group.name, name, terms, probability, noise * float(np.sqrt(max(gain, 0.0) / max(count, 1.0))))
