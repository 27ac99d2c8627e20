"""The noise floor: bias and scatter of every quantity in static pairs, compared with the stated uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from stereorig.core.certify.comparison import Outcome
from stereorig.core.certify.evidence import ScatterEvidence, StaticStep


@dataclass(frozen=True)
class FloorRow:
    """One quantity over the static steps.

    Attributes
    ----------
    name
        ``u_mm``, ``v_mm``, ``w_mm``, ``exx``, ``eyy``, ``exy``.
    bias
        Mean over points and steps.
    bias_range
        Smallest and largest mean of a step.
    scatter
        Standard deviation over the points of a step, root mean square over the steps.
    reported
        Root mean square of the standard uncertainties that the points state.
    ratio, low, high, coverage
        Scatter over reported, and the interval that holds the true ratio with this probability.
    points, steps
        Their numbers.
    outcome
        ``conditional`` if the interval is above 1, ``fail`` if it is above the limit.
    """

    name: str
    bias: float
    bias_range: tuple[float, float]
    scatter: float
    reported: float
    ratio: float
    low: float
    high: float
    coverage: float
    points: int
    steps: int
    outcome: Outcome


def noise_floor(steps: Sequence[StaticStep], *, ratio_limit: float, false_alarm: float) -> tuple[FloorRow, ...]:
    """Return the table, a row a quantity that all static steps have; empty without a static step.

    Parameters
    ----------
    ratio_limit
        Above it, a ratio fails.
    false_alarm
        Probability that any of the intervals misses its true ratio.

    Notes
    -----
    The steps share the noise of their reference, half of the variance of a displacement. The mean square over K steps
    of n independent values then scatters as a chi-square of 4 K / (K + 3) n degrees of freedom.
    """
    names = [name for name in (steps[0].scatter if steps else ()) if all(name in s.scatter for s in steps)]
    tail = 0.5 * false_alarm / max(len(names), 1)
    return tuple(_row(name, [s.scatter[name] for s in steps], ratio_limit, tail) for name in names)


def _row(name: str, found: Sequence[ScatterEvidence], ratio_limit: float, tail: float) -> FloorRow:
    count = len(found)
    means = [one.mean for one in found]
    scatter = float(np.sqrt(np.mean([one.sd**2 for one in found])))
    reported = float(np.sqrt(np.mean([one.reported**2 for one in found])))
    ratio = scatter / reported if reported > 0.0 else float("nan")
    degrees = 4.0 * count / (count + 3.0) * max(min(one.independent for one in found) - 1.0, 1.0)
    low = ratio * float(np.sqrt(degrees / chdtri(degrees, tail)))
    high = ratio * float(np.sqrt(degrees / chdtri(degrees, 1.0 - tail)))
    outcome: Outcome = "pass" if low <= 1.0 else "conditional"
    if not low <= ratio_limit:
        outcome = "fail"
    return FloorRow(
        name=name,
        bias=float(np.mean(means)),
        bias_range=(min(means), max(means)),
        scatter=scatter,
        reported=reported,
        ratio=ratio,
        low=low,
        high=high,
        coverage=1.0 - 2.0 * tail,
        points=min(one.points for one in found),
        steps=count,
        outcome=outcome,
    )


def independent_values(points: int, spacing: float, width: float) -> float:
    """Return the number of independent values among points of a grid whose windows overlap.

    Two windows of this width at this distance share a triangular part of their pixels along each axis; the variance of
    a sum of squares grows by the sum of these correlations squared.

    Parameters
    ----------
    points
        Number of points.
    spacing, width
        Spacing of the grid and width of the windows, in one unit.
    """
    reach = int(np.ceil(width / spacing))
    along = 1.0 + 2.0 * sum((1.0 - k * spacing / width) ** 2 for k in range(1, reach))
    return points / along**2
