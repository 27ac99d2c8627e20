"""Frames and rigid motions, as readings state them."""

from __future__ import annotations

import numpy as np

from stereorig.core.gauge.align import Alignment
from stereorig.core.gauge.reading import Reading
from stereorig.core.gauge.rigid import RigidMotion
from stereorig.server.formats.gauges.readings import FrameReading, RigidMotionReading
from stereorig.server.results.gauges.numbers import number

_MOTION = (("rotation", "rad"), ("translation", "mm"))


def frame_reading(alignment: Alignment) -> FrameReading:
    """Return a frame as readings state it."""
    sigma = np.sqrt(np.diag(alignment.covariance))
    return FrameReading(
        rotation=alignment.rotation.tolist(),
        origin_mm=alignment.origin_mm.tolist(),
        sigma_rad=sigma[:3].tolist(),
        sigma_origin_mm=sigma[3:].tolist(),
        residual_rms_mm=alignment.residual_rms_mm,
        points=alignment.points,
        budget_rad=[one.document() for one in alignment.budgets[:3]],
        budget_origin_mm=[one.document() for one in alignment.budgets[3:]],
    )


def motion_reading(motion: RigidMotion) -> RigidMotionReading:
    """Return a rigid motion as readings state it."""
    sigma = np.sqrt(np.diag(motion.covariance))
    found = np.concatenate([motion.rotation_vector_rad, motion.translation_mm])
    names = [f"{quantity}_{axis}_{unit}" for quantity, unit in _MOTION for axis in "xyz"]
    units = [unit for _, unit in _MOTION for _ in range(3)]
    numbers = zip(names, found, sigma, units, motion.sigma_common, motion.budgets, strict=True)
    return RigidMotionReading(
        values={
            name: number(Reading(float(value), float(s), float(part), budget), unit)
            for name, value, s, unit, part, budget in numbers
        },
        centre_mm=motion.centre_mm.tolist(),
        covariance=motion.covariance.tolist(),
        points=motion.points,
        residual_rms_mm=motion.residual_rms_mm,
        noise_ratio=motion.noise_ratio,
    )
