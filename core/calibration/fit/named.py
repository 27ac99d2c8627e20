"""The adjustment's unknowns as the parameters that a calibration states, by name."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.layout import Layout, Priors
from stereorig.core.cameras.camera import POSE_NAMES
from stereorig.core.names import CAMERAS, Cause


def parameter_names(layout: Layout, priors: Priors) -> tuple[str, ...]:
    """Names of both cameras' estimated parameters: ``cam1.phd_px`` and so on."""
    names: list[str] = []
    for c, camera in enumerate(CAMERAS):
        own = layout.form.names(aspect_estimated=_aspect_estimated(layout, priors, c))
        names.extend(f"{camera}.{name}" for name in (*own, *POSE_NAMES))
    return tuple(names)


def named_covariance(layout: Layout, priors: Priors, x: Float, covariance: Float) -> Float:
    """Covariance of the parameters in :func:`parameter_names` from the covariance (m, m) of the unknowns at ``x``."""
    J = named_derivatives(layout, priors, x)
    return np.asarray(J @ covariance @ J.T)


def named_by_cause(
    layout: Layout, priors: Priors, x: Float, covariance: Float, by_prior: Mapping[Cause, Float]
) -> dict[Cause, Float]:
    """Parts of the covariance of the parameters by cause: the priors', and all else as the calibration's own."""
    given = {cause: named_covariance(layout, priors, x, part) for cause, part in by_prior.items()}
    rest = named_covariance(layout, priors, x, covariance) - np.sum(list(given.values()), axis=0)
    return {"calibration": rest, **given}


def named_derivatives(layout: Layout, priors: Priors, x: Float) -> Float:
    """Derivatives (names, m) of the named parameters over the unknowns."""
    blocks = []
    for c in range(2):
        lens = layout.form.to_names(x[layout.lens(c)], aspect_estimated=_aspect_estimated(layout, priors, c))
        block = np.zeros((len(lens) + len(POSE_NAMES), layout.size))
        block[: len(lens), layout.lens(c)] = lens
        block[len(lens) :, layout.pose(c)] = np.eye(len(POSE_NAMES))
        blocks.append(block)
    return np.concatenate(blocks)


def _aspect_estimated(layout: Layout, priors: Priors, c: int) -> bool:
    return bool(priors.opened.free[layout.lens(c)][layout.form.aspect_index])
