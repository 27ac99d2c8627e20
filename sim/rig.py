"""Description of a simulated rig, read from a rig file's tables.

The rig file has nominal values under ``[cam1]`` and ``[cam2]`` and true ones under ``[sim]``. This module converts the
plain tables, as ``tomllib`` gives them, to frozen descriptions; other parts are ignored.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from core.cameras.camera import ELEVEN_PARAMETER_NAMES, Camera, RigidTransform
from core.errors import InputError
from core.names import CAMERAS, CameraName
from sim.sensor import Lighting, Sensor


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
        See :mod:`sim.sensor`.
    exposure_ms
        Exposure at which brightness 1 is full scale.
    stage_axis, stage_sign, stage_zero_mm
        ``dz = stage_sign * (position - zero)`` of that axis.
    axis_tilt_rad
        True direction of the travel: turned about the camera's x and y from its optical axis.
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

    def at(self, position_mm: float) -> Camera:
        """Return the true camera with its stage axis truly at ``position_mm``."""
        dz = self.stage_sign * (position_mm - self.stage_zero_mm)
        about_x, about_y = self.axis_tilt_rad
        direction = np.array([np.sin(about_y), -np.sin(about_x) * np.cos(about_y), np.cos(about_x) * np.cos(about_y)])
        pose = self.camera.cam_from_sys
        return Camera(self.camera.lens, RigidTransform(pose.rotation, pose.translation_mm + dz * direction))


@dataclass(frozen=True, kw_only=True)
class SimTarget:
    """The calibration target's description, as in the rig file's ``[target]``."""

    pitch_mm: float
    lines: tuple[int, int]
    line_width_mm: float
    node_tolerance_mm: float = 0.0
    dark_lines: bool = True


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
        Of the target's errors, the speckle and the steel's roughness: the same seed is the same laboratory.
    speckle_mm
        Mean diameter of the specimens' speckles.
    blur_px
        Lens blur.
    """

    name: str
    cam1: SimCamera
    cam2: SimCamera
    target: SimTarget
    seed: int = 0
    speckle_mm: float = 0.145
    blur_px: float = 0.7

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
    lines = tuple(int(n) for n in target["lines"])
    if len(lines) != 2:
        raise ValueError(f"target.lines must be two numbers, got {target['lines']}")
    return SimRig(
        name=str(tables.get("rig", {}).get("name", "simulated rig")),
        cam1=_camera(tables["cam1"], sim["cam1"], sim.get("noise", {})),
        cam2=_camera(tables["cam2"], sim["cam2"], sim.get("noise", {})),
        target=SimTarget(
            pitch_mm=float(target["pitch_mm"]),
            lines=(lines[0], lines[1]),
            line_width_mm=float(target["line_width_mm"]),
            node_tolerance_mm=float(target.get("node_tolerance_mm", 0.0)),
            dark_lines=bool(target.get("dark_lines", True)),
        ),
        seed=int(sim.get("seed", 0)),
        speckle_mm=float(sim["speckle_mm"]),
        blur_px=float(sim.get("blur_px", 0.7)),
    )


def _finite(table: Mapping[str, Any], name: str) -> float:
    value = float(table[name])
    if not np.isfinite(value):
        raise ValueError(f"{name} is {value}")
    return value


def _camera(known: Mapping[str, Any], true: Mapping[str, Any], noise: Mapping[str, Any]) -> SimCamera:
    columns, rows = (int(n) for n in known["image_size_px"])
    tilt_x, tilt_y = (float(a) for a in true.get("axis_tilt_rad", (0.0, 0.0)))
    right, down = (float(g) for g in true.get("gradient", (0.0, 0.0)))
    sign = int(known.get("stage_sign", 1))
    if sign not in (-1, 1):
        raise ValueError(f"stage_sign must be 1 or -1, got {sign}")
    sensor = Sensor(bit_depth=int(known.get("bit_depth", 8)), **{k: float(v) for k, v in noise.items()})
    return SimCamera(
        camera=Camera.from_paper(**{name: _finite(true, name) for name in ELEVEN_PARAMETER_NAMES}),
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
    )
