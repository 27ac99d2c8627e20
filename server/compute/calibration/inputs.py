"""What a kept plan says of target, cameras and settings, as the numerical modules take it."""

from __future__ import annotations

from typing import Any

from core.boards import BoardTarget
from core.calibration import CalibrationOptions, NominalCamera
from core.calibration.inputs import Moves
from core.names import CAMERAS
from core.target import GridTarget

_DEFAULTS = CalibrationOptions()


def target_of(table: dict[str, Any]) -> GridTarget | BoardTarget:
    """Return the target of a rig file's table, see :meth:`server.config.rig_file.TargetSection.plain`."""
    fields: dict[str, Any] = {k: tuple(value) if k in ("lines", "size") else value for k, value in table.items()}
    return BoardTarget(**fields) if fields.get("kind", "line_grid") != "line_grid" else _grid(fields)


def _grid(fields: dict[str, Any]) -> GridTarget:
    return GridTarget(**{name: value for name, value in fields.items() if name != "kind"})


def nominals_of(rig: dict[str, Any]) -> tuple[NominalCamera, NominalCamera]:
    """Return the nominal cameras of a plan's rig."""
    one, two = (
        NominalCamera(
            image_size_px=tuple(rig[cam]["image_size_px"]),
            phd_px=rig[cam]["phd_px"],
            standoff_mm=rig[cam]["standoff_mm"],
            angle_deg=rig[cam]["angle_deg"],
            aspect=rig[cam]["aspect"],
        )
        for cam in CAMERAS
    )
    return one, two


def options_of(
    rig: dict[str, Any], *, held_out_mm: tuple[float, ...] = (), moves: Moves | None = None
) -> CalibrationOptions:
    """Return the settings of a calibration by a plan's rig; ``moves`` in place of the rig's."""
    return CalibrationOptions(
        moves=moves or rig.get("moves", _DEFAULTS.moves),
        lens=rig.get("lens", _DEFAULTS.lens),
        held_out_mm=held_out_mm,
        axis_tilt_sigma_rad=rig["axis_tilt_sigma_rad"],
        stage_scale_sigma=rig.get("stage_scale_sigma", 0.0),
        stage_step_sigma_mm=rig.get("stage_step_sigma_mm", 0.0),
    )
