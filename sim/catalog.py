"""The scenes by name: specimen and load state.

======  ==================================================  =================================================
name    what                                                load
======  ==================================================  =================================================
grid    the calibration target, nodes off by its tolerance  none
steel   ground steel plate, Ra 1.775 um                     none
plate   clamped circular plate, Eq. (18)                    pressure, kPa
panel   centre-cracked panel in tension                     force, kN
block   rigid block                                         share of its ``translation_mm``, ``rotation_rad``
strip   stretched strip                                     strain along the strip, per cent
sphere  sphere of 30 mm radius                              share of its motion, as the block's
======  ==================================================  =================================================

Specimens lie near Z_sys = 0, centred on the system's origin, x to the right in the images and y down. Every scene takes
``translation_mm`` and ``rotation_rad`` (a rotation vector about the origin, both in the system frame) as a rigid
motion on top; for block and sphere the load multiplies it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from core.cameras.camera import RigidTransform
from core.errors import InputError
from sim.panel import CrackedPanel
from sim.plate import CircularPlate
from sim.rig import SimRig
from sim.scene import UPRIGHT, Scene
from sim.steel import PAPER_RA_UM, ground_steel
from sim.surface import Surface, flat, sphere
from sim.texture import Texture, line_grid, speckle

SCENE_NAMES = ("grid", "steel", "plate", "panel", "block", "strip", "sphere")
BLOCK_TRANSLATION_MM = (0.20, -0.15, 0.25)
BLOCK_ROTATION_RAD = (0.01, -0.015, 0.03)
_LAY_RAD = 0.35  # the steel's lay against the vertical
_STEEL_SEED, _SPECKLE_SEED = 1, 2  # separate streams of random numbers of one rig
_BACKLIT, _CHROME, _BEHIND = 0.9, 0.03, 0.04


def make_scene(
    rig: SimRig,
    name: str,
    *,
    load: float = 0.0,
    translation_mm: Sequence[float] | None = None,
    rotation_rad: Sequence[float] | None = None,
    **parameters: Any,
) -> Scene:
    """Build a scene in one state.

    Parameters
    ----------
    rig
        Gives target, speckle size and seed.
    name
        One of :data:`SCENE_NAMES`.
    load
        See the table above.
    translation_mm, rotation_rad
        Rigid motion on top, system frame.
    **parameters
        ``steel``: ``ra_um``. ``plate``: fields of :class:`CircularPlate`. ``panel``: fields of :class:`CrackedPanel`.
        ``strip``: ``poisson``. ``sphere``: ``radius_mm``. ``grid``: ``node_tolerance_mm``. All but the grid:
        ``speckle_mm``.

    Raises
    ------
    InputError
        ``unknown_scene``, ``scene_invalid``.
    """
    if name not in SCENE_NAMES:
        raise InputError(
            f"There is no scene {name!r}.", code="unknown_scene", remedy=f"Use one of {', '.join(SCENE_NAMES)}."
        )
    motion = (translation_mm, rotation_rad, load if name in ("block", "sphere") else 1.0)
    if name in ("block", "sphere") and translation_mm is None and rotation_rad is None:
        motion = (BLOCK_TRANSLATION_MM, BLOCK_ROTATION_RAD, load)
    try:
        if not np.isfinite(load):
            raise ValueError(f"load is {load}")
        speckles = parameters.pop("speckle_mm", rig.speckle_mm)
        return Scene(
            name=name,
            surface=_surface(rig, name, load, parameters),
            texture=_target(rig, parameters) if name == "grid" else _paint(rig, float(speckles)),
            sys_from_body=_moved(_mounting(name), *motion),
            background=(_BACKLIT if rig.target.dark_lines else _CHROME) if name == "grid" else _BEHIND,
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"The scene {name!r} cannot be made: {error}.", code="scene_invalid", remedy="Correct load or parameter."
        ) from error


def _surface(rig: SimRig, name: str, load: float, parameters: dict[str, Any]) -> Surface:
    if name == "grid":
        return flat()
    if name == "steel":
        return ground_steel(seed=_seed(rig, _STEEL_SEED), ra_um=float(parameters.get("ra_um", PAPER_RA_UM)))
    if name == "plate":
        return CircularPlate(**parameters).surface(load)
    if name == "panel":
        return CrackedPanel(**parameters).surface(load)
    if name == "strip":
        strain = 0.01 * load
        # pulled along y, which runs down in the images
        return flat([[1.0 - float(parameters.get("poisson", 0.33)) * strain, 0.0], [0.0, 1.0 + strain]])
    if name == "sphere":
        return sphere(float(parameters.get("radius_mm", 30.0)))
    return flat()


def _target(rig: SimRig, parameters: dict[str, Any]) -> Texture:
    target = rig.target
    return line_grid(
        pitch_mm=target.pitch_mm,
        lines=target.lines,
        line_width_mm=target.line_width_mm,
        node_tolerance_mm=float(parameters.get("node_tolerance_mm", target.node_tolerance_mm)),
        dark_lines=target.dark_lines,
        seed=rig.seed,
        dark=_CHROME,
        bright=_BACKLIT,
    )


def _paint(rig: SimRig, diameter_mm: float) -> Texture:
    return speckle(diameter_mm=diameter_mm, seed=_seed(rig, _SPECKLE_SEED))


def _seed(rig: SimRig, purpose: int) -> int:
    return int(np.random.SeedSequence([rig.seed, purpose]).generate_state(1)[0])


def _mounting(name: str) -> RigidTransform:
    if name == "grid":
        return RigidTransform.identity()  # it defines the system frame
    if name == "steel":
        return UPRIGHT @ RigidTransform(Rotation.from_rotvec([0.0, 0.0, _LAY_RAD]).as_matrix(), np.zeros(3))
    return UPRIGHT


def _moved(
    mounting: RigidTransform, translation_mm: Sequence[float] | None, rotation_rad: Sequence[float] | None, share: float
) -> RigidTransform:
    translation = share * np.asarray((0.0, 0.0, 0.0) if translation_mm is None else translation_mm, dtype=np.float64)
    turn = share * np.asarray((0.0, 0.0, 0.0) if rotation_rad is None else rotation_rad, dtype=np.float64)
    if not (np.isfinite(translation).all() and np.isfinite(turn).all()):
        raise ValueError(f"motion is not finite: {translation_mm}, {rotation_rad}")
    return RigidTransform(Rotation.from_rotvec(turn).as_matrix(), translation) @ mounting
