"""Target, cameras and settings of a stored plan, as the numerical modules take them."""

from __future__ import annotations

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationOptions, NominalValues
from stereorig.core.calibration.inputs import Moves
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from stereorig.server.compute.tasks import Plain

_DEFAULTS = CalibrationOptions()


def target_of(table: Plain) -> GridTarget | BoardTarget:
    """Return the target of a rig file's table, see :meth:`stereorig.server.config.rig_file.TargetSection.plain`."""
    fields: Plain = {
        k: tuple(value) if k in ("lines", "size", "missing_lines") else value for k, value in table.items()
    }
    return BoardTarget(**fields) if fields.get("kind", "line_grid") != "line_grid" else _grid(fields)


def _grid(fields: Plain) -> GridTarget:
    return GridTarget(**{name: value for name, value in fields.items() if name != "kind"})


def nominals_of(rig: Plain) -> tuple[NominalValues, NominalValues]:
    """Return the nominal cameras of a plan's rig."""
    one, two = (
        NominalValues(
            image_size_px=tuple(rig[cam]["image_size_px"]),
            phd_px=rig[cam]["phd_px"],
            standoff_mm=rig[cam]["standoff_mm"],
            angle_deg=rig[cam]["angle_deg"],
            aspect=rig[cam]["aspect"],
        )
        for cam in CAMERAS
    )
    return one, two


def options_of(rig: Plain, *, held_out_mm: tuple[float, ...] = (), moves: Moves | None = None) -> CalibrationOptions:
    """Return the settings of a calibration by a plan's rig; ``moves`` in place of the rig's."""
    return CalibrationOptions(
        moves=moves or rig.get("moves", _DEFAULTS.moves),
        lens=rig.get("lens", _DEFAULTS.lens),
        held_out_mm=held_out_mm,
        axis_tilt_sigma_rad=rig["axis_tilt_sigma_rad"],
        stage_scale_sigma=rig.get("stage_scale_sigma"),
        stage_step_sigma_mm=rig.get("stage_step_sigma_mm", 0.0),
        aspect_sigma=rig.get("aspect_sigma"),
    )
