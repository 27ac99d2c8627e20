"""Where a dot's image has its centre: not at the image of the dot's centre, under perspective and lens distortion."""

from __future__ import annotations

import numpy as np

from core.arrays import Float
from core.cameras.camera import Camera

_OUTLINE = 48  # points of a dot's outline


def dot_offsets_px(camera: Camera, nodes_mm: Float, radius_mm: float) -> Float:
    """Centres of imaged dots minus images of the dots' centres.

    Parameters
    ----------
    camera
        With its pose towards the target, ``cam_from_target``.
    nodes_mm
        (n, 3) the dots' centres, target frame.
    radius_mm
        Radius of the dots.

    Returns
    -------
    Float
        (n, 2), zero where a dot has no image.

    References
    ----------
    J. Heikkila (2000), A four-step camera calibration procedure, doi:10.1109/34.879788, has it without distortion.
    """
    angle = 2.0 * np.pi * np.arange(_OUTLINE) / _OUTLINE
    ring = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros(_OUTLINE)], axis=-1)
    middle = camera.project(nodes_mm).xy
    rim = camera.project(nodes_mm[:, None, :] + ring).xy - middle[:, None]
    after = np.roll(rim, -1, axis=1)
    cross = rim[..., 0] * after[..., 1] - rim[..., 1] * after[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        centroid = ((rim + after) * cross[..., None]).sum(axis=1) / (3.0 * cross.sum(axis=1)[:, None])
    return np.where(np.isfinite(centroid), centroid, 0.0)
