"""A scene: analytic surface, texture in material coordinates, and the body's pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stereorig.core.cameras.camera import RigidTransform
from stereorig.sim.surface import Surface
from stereorig.sim.texture import Texture

# bodies are mounted so that their x runs to the right in the images and y down, though the target's lines are at 45
# degrees
UPRIGHT = RigidTransform(
    np.array([[np.sqrt(0.5), np.sqrt(0.5), 0.0], [-np.sqrt(0.5), np.sqrt(0.5), 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One state of one specimen.

    Attributes
    ----------
    name
        Name of the scene.
    surface
        Shape with its deformation, in the body's frame.
    texture
        Brightness of the material points.
    sys_from_body
        Rigid motion of the whole body.
    half_size_mm
        The body ends at |s|, |t| of this; endless by default, so that it fills the views.
    background
        Brightness seen where a ray meets nothing.
    smear_mm
        Way of the body during one exposure, system frame, its middle at ``sys_from_body``.
    """

    name: str
    surface: Surface
    texture: Texture
    sys_from_body: RigidTransform = field(default_factory=RigidTransform.identity)
    half_size_mm: tuple[float, float] = (np.inf, np.inf)
    background: float = 0.05
    smear_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
