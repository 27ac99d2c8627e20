"""Description of a simulated rig, read from a rig file's tables.

The rig file has nominal values under ``[cam1]`` and ``[cam2]`` and true ones under ``[sim]``. This module converts the
plain tables, as ``tomllib`` gives them, to frozen descriptions; other parts are ignored.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import (
    ELEVEN_PARAMETER_NAMES,
    POSE_NAMES,
    Camera,
    RigidTransform,
    rotation_from_angles,
)
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.sim.boards.target import SimTarget, target_from_tables
from stereorig.sim.optics.lens import core_lens, lens_from_table
from stereorig.sim.sensor import Lighting, Sensor

STAGE_MOVES = ("cameras", "target", "both_cameras")
_WARM_STEP_PX = 0.002


@dataclass(frozen=True, kw_only=True)
class WarmUp:
    """Drift of a camera that warms: by the share 1 - exp(-n / frames) of it after n exposures, so without a clock.

    Attributes
    ----------
    shift_px
        Way of the principal point in the end.
    focal
        Relative growth of the focal length in the end.
    frames
        Exposures that take it to 63 %.
    """

    shift_px: tuple[float, float] = (0.0, 0.0)
    focal: float = 0.0
    frames: float = 100.0

    def share(self, exposures: int, size_px: tuple[int, int]) -> float:
        """Share of the drift after so many exposures, in steps that move no point by more than 0.002 px."""
        reach = float(np.hypot(*self.shift_px)) + abs(self.focal) * 0.5 * float(np.hypot(*size_px))
        steps = int(np.ceil(reach / _WARM_STEP_PX))
        return 0.0 if steps == 0 else round((1.0 - np.exp(-exposures / self.frames)) * steps) / steps


@dataclass(frozen=True, kw_only=True)
class SimCamera:
    """One true camera with its sensor, its light and its stage axis.

    Attributes
    ----------
    camera
        The true camera at dz = 0.
    size_px
        Columns and rows.
    sensor, lighting
        See :mod:`stereorig.sim.sensor`.
    exposure_ms
        Exposure at which brightness 1 is full scale.
    stage_axis, stage_sign, stage_zero_mm
        ``dz = stage_sign * (position - zero)`` of that axis.
    axis_tilt_rad
        True direction of the travel: turned about the camera's x and y from its optical axis.
    stage_scale
        True travel over indicated travel.
    warm_up
        Drift of its lens while it warms.
    """

    camera: Camera
    size_px: tuple[int, int]
    sensor: Sensor
    lighting: Lighting
    exposure_ms: float = 10.0
    stage_axis: int = 1
    stage_sign: int = 1
    stage_zero_mm: float = 0.0
    axis_tilt_rad: tuple[float, float] = (0.0, 0.0)
    stage_scale: float = 1.0
    warm_up: WarmUp = field(default_factory=WarmUp)

    def dz_mm(self, position_mm: float) -> float:
        """Indicated travel with the stage axis at ``position_mm``."""
        return self.stage_sign * (position_mm - self.stage_zero_mm)

    def at(self, position_mm: float) -> Camera:
        """Return the true camera with its stage axis truly at ``position_mm``."""
        dz = self.stage_scale * self.dz_mm(position_mm)
        about_x, about_y = self.axis_tilt_rad
        direction = np.array([np.sin(about_y), -np.sin(about_x) * np.cos(about_y), np.cos(about_x) * np.cos(about_y)])
        pose = self.camera.cam_from_sys
        return Camera(self.camera.lens, RigidTransform(pose.rotation, pose.translation_mm + dz * direction))


@dataclass(frozen=True, kw_only=True)
class SimStage:
    """Motion of the stage.

    Attributes
    ----------
    moves
        ``cameras``: each axis moves its own camera along that camera's axis; ``target``: one axis moves the target and
        every other body; ``both_cameras``: one axis moves the pair of cameras.
    direction
        (3,) unit vector of a single axis's travel, system frame: the direction in which the target goes, or from which
        the cameras come, as the axis moves target and cameras away from each other.
    scale
        True travel over indicated travel.
    """

    moves: str = "cameras"
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    scale: float = 1.0

    def travel_mm(self, dz_mm: float) -> Float:
        """Displacement (3,) of the target against the cameras, system frame, at an indicated travel."""
        return np.asarray(self.direction) * (self.scale * dz_mm)


@dataclass(frozen=True, kw_only=True)
class SimRig:
    """True description of a simulated rig.

    Attributes
    ----------
    name
        From ``[rig]``.
    cam1, cam2
        The cameras.
    target
        Its nominal description; the maker's errors follow from the seed.
    seed
        Seed of the target's errors, the speckle and the steel's roughness: the same seed is the same laboratory.
    speckle_mm
        Mean diameter of the specimens' speckles.
    blur_px
        Lens blur.
    stage
        Motion of the stage.
    """

    name: str
    cam1: SimCamera
    cam2: SimCamera
    target: SimTarget
    seed: int = 0
    speckle_mm: float = 0.145
    blur_px: float = 0.7
    stage: SimStage = field(default_factory=SimStage)

    def camera(self, name: CameraName) -> SimCamera:
        """Return one of the two by name."""
        if name not in CAMERAS:
            raise InputError(f"There is no camera {name!r}.", code="unknown_camera", remedy="Use cam1 or cam2.")
        return self.cam1 if name == "cam1" else self.cam2

    @staticmethod
    def from_dict(tables: Mapping[str, Any]) -> SimRig:
        """Read a rig file's tables ``rig``, ``cam1``, ``cam2``, ``target`` and ``sim`` with ``sim.cam1``, ``sim.cam2``.

        Raises
        ------
        InputError
            ``rig_invalid`` when something is missing or is no number.
        """
        try:
            return _rig(tables)
        except KeyError as error:
            raise InputError(
                f"The simulated rig's description lacks {error.args[0]!r}.",
                code="rig_invalid",
                remedy="Compare with config/sim_paper.toml.",
            ) from error
        except (TypeError, ValueError) as error:
            raise InputError(
                f"The simulated rig's description is not usable: {error}.",
                code="rig_invalid",
                remedy="Compare with config/sim_paper.toml.",
            ) from error

    @staticmethod
    def from_toml(path: str | Path) -> SimRig:
        """Read a rig file; raises InputError ``rig_unreadable`` or ``rig_invalid``."""
        try:
            tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise InputError(
                f"The rig file {path} cannot be read: {error}.", code="rig_unreadable", remedy="Give a TOML rig file."
            ) from error
        return SimRig.from_dict(tables)


def _rig(tables: Mapping[str, Any]) -> SimRig:
    sim, target = tables["sim"], tables["target"]
    stage = _stage(sim)
    return SimRig(
        name=str(tables.get("rig", {}).get("name", "simulated rig")),
        cam1=_camera(tables["cam1"], sim["cam1"], sim.get("noise", {}), stage.scale),
        cam2=_camera(tables["cam2"], sim["cam2"], sim.get("noise", {}), stage.scale),
        target=target_from_tables(target, sim.get("target", {})),
        seed=int(sim.get("seed", 0)),
        speckle_mm=float(sim["speckle_mm"]),
        blur_px=float(sim.get("blur_px", 0.7)),
        stage=stage,
    )


def _stage(sim: Mapping[str, Any]) -> SimStage:
    moves = str(sim.get("stage_moves", "cameras"))
    if moves not in STAGE_MOVES:
        raise ValueError(f"stage_moves must be one of {', '.join(STAGE_MOVES)}, got {moves!r}")
    x, y, z = (float(v) for v in sim.get("stage_direction", (0.0, 0.0, 1.0)))
    length, scale = float(np.linalg.norm([x, y, z])), float(sim.get("stage_scale", 1.0))
    if not (np.isfinite(length) and length > 0.0 and 0.5 < scale < 2.0):
        raise ValueError(f"stage_direction [{x:g}, {y:g}, {z:g}] with stage_scale {scale:g} is no travel")
    return SimStage(moves=moves, direction=(x / length, y / length, z / length), scale=scale)


def _finite(table: Mapping[str, Any], name: str) -> float:
    value = float(table[name])
    if not np.isfinite(value):
        raise ValueError(f"{name} is {value}")
    return value


def _optics(true: Mapping[str, Any]) -> Camera:
    kind = true.get("lens", "paper")
    if kind == "paper":
        return Camera.from_paper(**{name: _finite(true, name) for name in ELEVEN_PARAMETER_NAMES})
    if kind != "opencv":
        raise ValueError(f"lens must be 'paper' or 'opencv', got {kind!r}")
    alpha, beta, gamma, x0, y0, z0 = (_finite(true, name) for name in POSE_NAMES)
    pose = RigidTransform(rotation_from_angles(alpha, beta, gamma), np.array([x0, y0, z0]))
    return Camera(core_lens(lens_from_table(true)), pose)


def _warm_up(true: Mapping[str, Any]) -> WarmUp:
    x, y = (float(v) for v in true.get("warm_up_px", (0.0, 0.0)))
    focal, frames = float(true.get("warm_up_focal", 0.0)), float(true.get("warm_up_frames", 100.0))
    if not (np.isfinite([x, y]).all() and abs(focal) < 0.1 and 0.0 < frames < np.inf):
        raise ValueError(f"warm_up_px [{x:g}, {y:g}], warm_up_focal {focal:g}, warm_up_frames {frames:g} are no drift")
    return WarmUp(shift_px=(x, y), focal=focal, frames=frames)


def _camera(
    known: Mapping[str, Any], true: Mapping[str, Any], noise: Mapping[str, Any], stage_scale: float
) -> SimCamera:
    columns, rows = (int(n) for n in known["image_size_px"])
    tilt_x, tilt_y = (float(a) for a in true.get("axis_tilt_rad", (0.0, 0.0)))
    right, down = (float(g) for g in true.get("gradient", (0.0, 0.0)))
    sign = int(known.get("stage_sign", 1))
    if sign not in (-1, 1):
        raise ValueError(f"stage_sign must be 1 or -1, got {sign}")
    sensor = Sensor(bit_depth=int(known.get("bit_depth", 8)), **{k: float(v) for k, v in noise.items()})
    return SimCamera(
        camera=_optics(true),
        size_px=(columns, rows),
        sensor=sensor,
        lighting=Lighting(
            gain=float(true.get("gain", 1.0)),
            vignetting=float(true.get("vignetting", 0.0)),
            gradient=(right, down),
            ambient=float(true.get("ambient", 0.0)),
        ),
        exposure_ms=float(known.get("exposure_ms", 10.0)),
        stage_axis=int(known.get("stage_axis", 1)),
        stage_sign=sign,
        stage_zero_mm=float(known.get("stage_zero_mm", 0.0)),
        axis_tilt_rad=(tilt_x, tilt_y),
        stage_scale=stage_scale,
        warm_up=_warm_up(true),
    )
