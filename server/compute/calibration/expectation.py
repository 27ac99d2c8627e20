"""Expected uncertainties of a planned calibration and measurement, as the API and the command line state them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration.expect import Expectation, LineModel, expect
from stereorig.core.calibration.inputs import AnyTarget
from stereorig.core.calibration.prepare import EXPECTED_NOISE_PX
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS
from stereorig.core.plan.quantities import planned_quantities
from stereorig.core.plan.settings import PlannedMeasurement, PlannedRig
from stereorig.core.plan.synthetic import Sizes, correlation_px, match_variance_px2
from stereorig.core.plan.view import planned_view
from stereorig.server.compute.calibration.inputs import nominals_of, options_of, target_of
from stereorig.server.compute.tasks import Plain

Localiser = Literal["profile", "paper"]
_CORNERS = tuple(f"{z} {y} {x}" for z in ("back", "front") for y in ("-Y", "+Y") for x in ("-X", "+X"))


@dataclass(frozen=True, kw_only=True)
class PlannedCalibration:
    """Positions that are fitted, and how intersections are found."""

    positions_mm: Sequence[float]
    localiser: Localiser = "profile"
    noise_px: float | None = None
    roll_deg: float = 0.0


def rig_as_planned(rig: Plain, planned: PlannedRig) -> Plain:
    """Return a rig's entries with a plan's differences.

    Parameters
    ----------
    rig
        As :func:`stereorig.server.workflows.calibration.sequence.rig_metadata` gives them.
    planned
        Values that differ from the rig's; None: as in the rig.
    """
    stage = planned.model_dump(include={"stage_step_sigma_mm", "stage_scale_sigma", "axis_tilt_sigma_rad"})
    target = planned.model_dump(include={"pitch_mm", "node_tolerance_mm", "pitch_scale_sigma"})
    if planned.lines is not None:
        target["lines" if rig["target"].get("kind", "line_grid") == "line_grid" else "size"] = planned.lines
    camera = planned.model_dump(include={"image_size_px", "standoff_mm"}) | {"phd_px": planned.pinhole_px}
    out = rig | _stated(stage) | {"target": rig["target"] | _stated(target)}
    for name, sign in zip(CAMERAS, (-1.0, 1.0), strict=True):
        angle = None if planned.angle_deg is None else 0.5 * sign * planned.angle_deg
        lens = _stated({"focal_length_mm": planned.focal_mm, "f_number": planned.f_number})
        stated = _stated(camera | {"angle_deg": angle})
        out[name] = rig[name] | stated | {"lens": (rig[name].get("lens") or {}) | lens}
    return out


def _stated(values: dict[str, object]) -> dict[str, object]:
    return {key: value for key, value in values.items() if value is not None}


def expectation_document(
    rig: Plain,
    plan: PlannedCalibration,
    measured: PlannedMeasurement,
    more: Callable[[StereoPair, Sizes, ParameterCovariance, PlannedMeasurement], dict[str, object]] | None = None,
) -> dict[str, object]:
    """Return the uncertainties to expect from a plan.

    Parameters
    ----------
    rig
        Entries of the rig file that a calibration needs, see :func:`rig_as_planned`.
    plan, measured
        The calibration and the measurement.
    more
        Function of cameras, image sizes, parameters and measurement that returns further entries.

    Raises
    ------
    CalibrationInputError
        A plan that would be refused before anything moves.
    CalibrationError
        ``calibration_singular``.
    """
    target = target_of(rig["target"])
    nominals, options = nominals_of(rig), options_of(rig)
    if options.moves == "free":
        raise CalibrationInputError(
            'The rig file declares moves = "free": no stage position gives the position of the target.',
            code="moves_undeclared",
            remedy="Declare the part that the stage moves; for free poses use the guided acquisition.",
        )
    model = _line_model(target, plan.localiser)
    noise = EXPECTED_NOISE_PX if plan.noise_px is None else plan.noise_px
    sizes = nominals[0].image_size_px, nominals[1].image_size_px
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            found = expect(
                plan.positions_mm, target, nominals, options, noise_px=noise, roll_deg=plan.roll_deg, line_model=model
            )
            source = ParameterCovariance(found.pair, tuple(found.parameters), found.covariance, found.by_cause)
            quantities = planned_quantities(found.pair, sizes, source, measured)
            further = {} if more is None else more(found.pair, sizes, source, measured)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise CalibrationError(
            f"The planned rig's numbers cannot be calculated with ({error}).",
            code="calibration_singular",
            remedy="Plan cameras at an angle, a stand-off and a target that a rig can have.",
        ) from error
    return {
        "assumed": {
            "noise_px": noise,
            "line_model": model,
            "roll_deg": plan.roll_deg,
            "text": f"Each intersection is found to {noise:g} px a coordinate ({model} lines); the cameras are the rig "
            f"file's, look at the target's centre and see it turned by {plan.roll_deg:g} degrees.",
        },
        **_calibration_part(found),
        "measurement": {
            **measured.model_dump(),
            "match_px": float((2.0 * match_variance_px2(measured)) ** 0.5),
            "gradient_grey_per_px": measured.contrast_grey / correlation_px(measured),
            "text": _measured_text(measured),
        },
        "views": {name: _view(rig[name], measured) for name in CAMERAS},
        **further,
        "quantities": [asdict(q) | {"budget": dict(q.budget)} for q in quantities],
    }


def _view(camera: Plain, measured: PlannedMeasurement) -> dict[str, object]:
    """Return what a camera sees, as far as the rig file and the plan state it."""
    lens = camera.get("lens") or {}
    found = planned_view(
        camera["image_size_px"],
        camera["phd_px"],
        camera["standoff_mm"],
        focal_mm=lens.get("focal_length_mm"),
        f_number=lens.get("f_number"),
        exposure_ms=camera.get("exposure_ms") if measured.exposure_ms is None else measured.exposure_ms,
        speed_mm_s=measured.speed_mm_s,
    )
    return asdict(found)


def _line_model(target: AnyTarget, localiser: Localiser) -> LineModel:
    if isinstance(target, BoardTarget):
        return "local"  # points are found one by one
    if localiser == "profile":
        # as stereorig.core.calibration.from_images chooses
        return "local" if target.node_tolerance_mm > 0.0 else "straight"
    return "parabola"


def _calibration_part(found: Expectation) -> dict[str, object]:
    return {
        "parameters": {n: {"value": v, "sigma": found.sigma[n]} for n, v in found.parameters.items()},
        "points": [
            {"name": name, "xyz_mm": xyz, "sigma_mm": sigma}
            for name, xyz, sigma in zip(
                ("middle", *_CORNERS), found.points_mm.tolist(), found.sigma_mm.tolist(), strict=True
            )
        ],
        "shape_rms_mm": found.volume.shape_rms_mm,
        "scale": found.volume.scale,
        "centre_px": found.volume.centre_px,
        "standoff_relative": found.volume.standoff_relative,
        "seen_share": {"cam1": found.seen[0], "cam2": found.seen[1]},
        "refused": bool(found.reasons),
        "reasons": list(found.reasons),
    }


def _measured_text(measured: PlannedMeasurement) -> str:
    slope = measured.contrast_grey / correlation_px(measured)
    return (
        f"A flat surface in the target's plane, seen to {1e3 * (2.0 * match_variance_px2(measured)) ** 0.5:.2g} "
        f"thousandths of a pixel a comparison: subset {measured.subset_px} px, gradient {slope:.3g} grey levels a "
        f"pixel (rms, one direction), noise {measured.image_noise_grey:g} grey levels, plane patches. Standard "
        "uncertainties (k = 1). Not included: interpolation's bias, bias of patches and windows on bends, a lens "
        "beyond the model."
    )
