"""The scenes by name: specimen and load state.

======  ==================================================  =================================================
name    specimen                                            load
======  ==================================================  =================================================
grid    the calibration target, of any kind                 none
steel   ground steel plate, Ra 1.775 um                     none
plate   clamped circular plate, Eq. (18)                    pressure, kPa
panel   centre-cracked panel in tension                     force, kN
block   rigid block                                         share of its ``translation_mm``, ``rotation_rad``
strip   stretched strip                                     strain along the strip, per cent
sphere  sphere of 30 mm radius                              share of its motion, as the block's
======  ==================================================  =================================================

``line_grid``, ``checkerboard``, ``charuco``, ``circles`` and ``circles_asymmetric`` are targets of that kind,
independent of the rig's own target.

Specimens are near Z_sys = 0, centred on the system's origin, x to the right in the images and y down. Every scene takes
``translation_mm`` and ``rotation_rad`` (a rotation vector about the origin, both in the system frame) as a rigid motion
on top; for block and sphere the load multiplies it. A target takes ``pose`` or ``hand`` before that, see
`stereorig.sim.boards.poses`, and ``smear_mm``, its way during an exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.errors import InputError
from stereorig.sim.boards.pattern import BEHIND
from stereorig.sim.boards.poses import hand_pose, transform_of
from stereorig.sim.boards.target import TARGET_KINDS, SimTarget
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.plate import CircularPlate
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.steel import PAPER_RA_UM, ground_steel
from stereorig.sim.surface import Surface, flat, sphere
from stereorig.sim.texture import Texture, speckle

SPECIMENS = ("steel", "plate", "panel", "block", "strip", "sphere")
SCENE_NAMES = ("grid", *SPECIMENS)
TARGET_SCENES = ("grid", *TARGET_KINDS)
BLOCK_TRANSLATION_MM = (0.20, -0.15, 0.25)
BLOCK_ROTATION_RAD = (0.01, -0.015, 0.03)
_LAY_RAD = 0.35  # angle of the steel's lay to the vertical
_STEEL_SEED, _SPECKLE_SEED = 1, 2  # separate streams of random numbers of one rig
_BEHIND = 0.04
_WIDEST_SMEAR_MM = 1e3


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
        One of :data:`SCENE_NAMES` or :data:`TARGET_SCENES`.
    load
        See the table above.
    translation_mm, rotation_rad
        Rigid motion on top, system frame.
    **parameters
        ``steel``: ``ra_um``. ``plate``: fields of :class:`CircularPlate`. ``panel``: fields of :class:`CrackedPanel`.
        ``strip``: ``poisson``. ``sphere``: ``radius_mm``. Targets: ``pose`` or ``hand``, ``smear_mm``, and
        attributes of :class:`SimTarget` such as ``node_tolerance_mm`` and ``bow_mm``. All but targets: ``speckle_mm``.

    Raises
    ------
    InputError
        ``unknown_scene``, ``scene_invalid``.
    """
    if name not in (*SCENE_NAMES, *TARGET_SCENES):
        names = ", ".join((*SCENE_NAMES, *TARGET_KINDS))
        raise InputError(f"There is no scene {name!r}.", code="unknown_scene", remedy=f"Use one of {names}.")
    motion = (translation_mm, rotation_rad, load if name in ("block", "sphere") else 1.0)
    if name in ("block", "sphere") and translation_mm is None and rotation_rad is None:
        motion = (BLOCK_TRANSLATION_MM, BLOCK_ROTATION_RAD, load)
    try:
        if not np.isfinite(load):
            raise ValueError(f"load is {load}")
        if name in TARGET_SCENES:
            return _target(rig, name, motion, parameters)
        if any(isinstance(value, str) for value in parameters.values()):
            raise ValueError("a specimen's parameters are numbers")
        speckles = parameters.pop("speckle_mm", rig.speckle_mm)
        return Scene(
            name=name,
            surface=_surface(rig, name, load, parameters),
            texture=_paint(rig, float(speckles)),
            sys_from_body=_moved(_mounting(name), *motion),
            background=_BEHIND,
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"The scene {name!r} cannot be made: {error}.", code="scene_invalid", remedy="Correct load or parameter."
        ) from error


def _surface(rig: SimRig, name: str, load: float, parameters: dict[str, Any]) -> Surface:
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


_Motion = tuple[Sequence[float] | None, Sequence[float] | None, float]


def target_of(rig: SimRig, name: str, parameters: dict[str, Any]) -> SimTarget:
    """Return the target of a target's scene with its changes; ValueError if they give no valid target."""
    kind = rig.target.kind if name == "grid" else name
    changes = {key: value for key, value in parameters.items() if key not in ("pose", "hand", "smear_mm")}
    if kind == rig.target.kind:
        if "pitch_mm" in changes:  # a larger print, all of it
            share = float(changes["pitch_mm"]) / rig.target.pitch_mm
            larger = {"line_width_mm": rig.target.line_width_mm * share, "marker_mm": rig.target.marker_mm * share}
            changes = larger | changes
        return rig.target.changed(changes)
    # another kind of target than the rig's own: of about its size, unless a size is asked for
    pitch = float(changes.pop("pitch_mm", rig.target.pitch_mm))
    usual = {
        "kind": kind,
        "pitch_mm": pitch,
        "size": (9, 6),
        "lines": (11, 11),
        "line_width_mm": 0.03 * pitch,
        "marker_mm": 0.7 * pitch,
    }
    return SimTarget(pitch_mm=pitch).changed(usual | changes)


def _target(rig: SimRig, name: str, motion: _Motion, parameters: dict[str, Any]) -> Scene:
    target = target_of(rig, name, parameters)
    pose, hand = parameters.get("pose"), parameters.get("hand")
    if pose is not None and hand is not None:
        raise ValueError("pose and hand exclude each other")
    if hand is not None:
        cameras = (rig.cam1, rig.cam2)
        pose = hand_pose(
            target, [cam.camera for cam in cameras], [cam.size_px for cam in cameras], _whole(hand), seed=rig.seed
        )
    # the grid's own pose defines the system frame
    at = RigidTransform.identity() if pose is None else transform_of(pose)
    texture, background = target.texture(rig.seed), target.background
    x, y, z = (float(v) for v in parameters.get("smear_mm", (0.0, 0.0, 0.0)))
    if not (np.abs([x, y, z]) < _WIDEST_SMEAR_MM).all():
        raise ValueError(f"smear_mm is [{x:g}, {y:g}, {z:g}]")
    half = (np.inf, np.inf) if background is not None else _half_plate(texture)
    return Scene(
        name=name,
        surface=target.surface(),
        texture=texture,
        sys_from_body=_moved(at, *motion),
        half_size_mm=half,
        background=BEHIND if background is None else background,
        smear_mm=(x, y, z),
    )


def _half_plate(texture: Texture) -> tuple[float, float]:
    """Half the size of a board with the soft edge of its rim."""
    rim = 10.0 * texture.finest_mm
    return float(texture.parameters[5]) + rim, float(texture.parameters[6]) + rim


def _whole(value: Any) -> int:
    if float(value) != int(value):
        raise ValueError(f"hand must be a whole number, got {value}")
    return int(value)


def _paint(rig: SimRig, diameter_mm: float) -> Texture:
    return speckle(diameter_mm=diameter_mm, seed=_seed(rig, _SPECKLE_SEED))


def _seed(rig: SimRig, purpose: int) -> int:
    return int(np.random.SeedSequence([rig.seed, purpose]).generate_state(1)[0])


def _mounting(name: str) -> RigidTransform:
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
