"""Growth of a crack over the steps: the tip's way with the joint covariance of all steps, and its rate."""

from __future__ import annotations

from functools import reduce

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.factor import Causes, joined
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.server.evaluations.crack.assessment import Assessed
from stereorig.server.evaluations.crack.document import GrowthFound


class Growth:
    """The tips of the steps, and what their errors share: the reference pair's noise and the common causes."""

    def __init__(self, field: Field, shared: SharedPixels) -> None:
        self._field, self._shared = field, shared
        self._steps: list[int] = []
        self._cycles: list[float | None] = []
        self._x_mm: list[float] = []
        self._new: list[float] = []  # variances from noise that is new at each step
        #: (r, c, 2) each: derivatives over the reference pair's noise, whitened but for shared pixels
        self._frozen: list[Float] = []
        self._common: list[tuple[Float, Causes]] = []

    def add(self, step: int, cycles: float | None, found: Assessed) -> None:
        """Add the tip of a step."""
        k = list(found.numbers).index("tip_x")
        points, spread, tip = found.points, found.spread, found.numbers["tip_x"]
        frozen = np.zeros((self._field.x_px.size, 2))
        new = found.fit.excess**2 * float(spread.own[k, k])
        if points.frozen is not None and spread.frozen is not None:
            frozen[points.at] = np.einsum("na,nab->nb", tip.gain, points.frozen)
            new = max(new - float(spread.frozen[k, k]), 0.0)
        common = np.zeros(0) if spread.common is None else spread.common[k]
        self._steps.append(step)
        self._cycles.append(cycles)
        self._x_mm.append(tip.value)
        self._new.append(new)
        self._frozen.append(frozen.reshape(*self._field.shape, 2))
        self._common.append((common, points.causes or Causes.unseparated(len(common))))

    def document(self, drawn_mm: float) -> GrowthFound | None:
        """Return the growth over cycles, or steps where they are not known; None for fewer than two tips.

        Errors that steps share cancel in the rates. ``drawn_mm`` is the length up to the drawn tip.
        """
        counted = None not in self._cycles
        at = np.array(self._cycles if counted else self._steps, dtype=np.float64)
        if len(at) < 2 or not (np.diff(at) > 0.0).all():
            return None
        every = reduce(joined, [causes for _, causes in self._common], Causes((), ()))
        common = np.stack([causes.aligned(row, every) for row, causes in self._common])
        covariance = common @ common.T + np.diag(self._new)
        for i, one in enumerate(self._frozen):
            around = self._shared.summed(self._field, one)
            covariance[:, i] += [float(np.sum(other * around)) for other in self._frozen]
        x, n = np.array(self._x_mm), len(at)
        between = np.diff(np.eye(n), axis=0) / np.diff(at)[:, None]
        line = np.linalg.pinv(np.stack([np.ones(n), at - at.mean()], axis=1))[1]
        weights = np.concatenate([between, line[None]])
        rates, rates_u = weights @ x, np.sqrt(np.maximum(np.diag(weights @ covariance @ weights.T), 0.0))
        return GrowthFound(
            against="cycles" if counted else "steps",
            steps=self._steps,
            at=at.tolist(),
            length_mm=(drawn_mm + x).tolist(),
            u_mm=np.sqrt(np.diag(covariance)).tolist(),
            rate=rates[:-1].tolist(),
            rate_u=rates_u[:-1].tolist(),
            mean_rate=float(rates[-1]),
            mean_rate_u=float(rates_u[-1]),
        )
