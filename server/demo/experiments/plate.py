"""The clamped circular plate under ten pressures: section 5.4 of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.server.demo.client import AnalysisHandle
from stereorig.server.demo.compare import MotionComparison, compare_motion, compare_shape
from stereorig.server.demo.drawing import fields as pictures
from stereorig.server.demo.drawing import strain as strain_pictures
from stereorig.server.demo.experiments import plate_strain
from stereorig.server.demo.session import DemoCheck, DemoRun, Outcome, table
from stereorig.server.demo.strain import fetched_strain
from stereorig.sim.plate import PAPER_PRESSURES_KPA, CircularPlate

ROI_PX = (86.0, 70.0, 426.0, 410.0)  # 341 x 341 px, as in the paper
SUBSET_PX, SPACING_PX = 21, 10
CENTRE_LIMIT_UM = 0.5
RADIUS_LIMIT_PERCENT = 0.5
_CENTRE_REACH_MM = 5.0  # an even polynomial of degree four is Eq. (18) itself


@dataclass(frozen=True)
class PlateFit:
    """Eq. (18) fitted to all pressures at once: radius and centre of the plate, mm."""

    radius_mm: float
    centre_mm: tuple[float, float]


def fit_plate(fields: list[Field], pressures_kpa: list[float], plate: CircularPlate) -> PlateFit:
    """Fit radius and centre of Eq. (18) to the out-of-plane displacements of all pressures, as in the paper.

    Stiffness, thickness and pressure are taken as known. If the plate carries load as a membrane too, the centre's
    deflection is taken from the large-deflection formula.
    """
    x, y, w, q = [], [], [], []
    for result, pressure in zip(fields, pressures_kpa, strict=True):
        if result.uvw_mm is None:
            raise ValueError("the result is a shape, not a displacement")
        use = result.valid
        x.append(result.xyz_mm[use, 0])
        y.append(result.xyz_mm[use, 1])
        w.append(result.uvw_mm[use, 2])
        q.append(np.full(int(use.sum()), pressure))
    xs, ys, ws, qs = (np.concatenate(a) for a in (x, y, w, q))

    def residuals(p: Float) -> Float:
        r2 = (xs - p[1]) ** 2 + (ys - p[2]) ** 2
        a = CircularPlate(
            radius_mm=float(p[0]),
            thickness_mm=plate.thickness_mm,
            youngs_modulus_mpa=plate.youngs_modulus_mpa,
            poisson=plate.poisson,
            large_deflection=plate.large_deflection,
        )
        centre = {pressure: a.centre_deflection_mm(pressure) for pressure in set(pressures_kpa)}
        w0 = np.array([centre[v] for v in pressures_kpa])[np.searchsorted(pressures_kpa, qs)]
        towards = -w0 * np.clip(1.0 - r2 / p[0] ** 2, 0.0, None) ** 2  # -Z_sys is towards the cameras
        return np.asarray(1e3 * (ws - towards))

    found = least_squares(residuals, [12.0, 0.0, 0.0], x_scale=[1.0, 1.0, 1.0])
    return PlateFit(float(found.x[0]), (float(found.x[1]), float(found.x[2])))


def centre_deflection_um(result: Field, centre_mm: tuple[float, float]) -> float:
    """Deflection towards the cameras at the centre: an even polynomial through the points within 5 mm of it."""
    if result.uvw_mm is None:
        raise ValueError("the result is a shape, not a displacement")
    r2 = (result.xyz_mm[..., 0] - centre_mm[0]) ** 2 + (result.xyz_mm[..., 1] - centre_mm[1]) ** 2
    with np.errstate(invalid="ignore"):
        use = result.valid & (r2 < _CENTRE_REACH_MM**2)
    if use.sum() < 10:
        return float("nan")
    design = np.column_stack([np.ones(int(use.sum())), r2[use], r2[use] ** 2])
    return float(-1e3 * np.linalg.lstsq(design, result.uvw_mm[use, 2], rcond=None)[0][0])


def run(session: DemoRun, calibration_id: str) -> Outcome:
    """Capture the plate at rest and at ten pressures, measure, compare."""
    plate, pressures = CircularPlate(), list(PAPER_PRESSURES_KPA)
    client = session.client
    test = client.create_test("Clamped circular plate", calibration_id, "aluminium, 0.762 mm, radius 13.385 mm")
    for pressure in [0.0, *pressures]:
        client.set_scene("plate", load=pressure)
        client.capture(test, f"{pressure:g} kPa")
    session.note(f"captured {len(pressures) + 1} steps")
    analysis = client.analyse(
        test, "displacement", {"rectangle": list(ROI_PX)}, subset_px=SUBSET_PX, spacing_px=SPACING_PX
    )
    shape, *fields = session.fetch(analysis, range(len(pressures) + 1))
    comparisons = [compare_motion(f, session.rig, "plate", q) for f, q in zip(fields, pressures, strict=True)]
    fit = fit_plate(fields, pressures, plate)
    outcome = _outcome(shape, fields, comparisons, pressures, plate, fit, session)
    image = session.reference_image(test)
    outcome.pictures |= pictures.plate(session.out, image, ROI_PX, fields, comparisons, pressures, plate, fit)
    strains = fetched_strain(session, range(1, len(pressures) + 1))
    found = [
        plate_strain.plate_strain(f, s, c, q, plate, fit.centre_mm)
        for f, s, c, q in zip(fields, strains, comparisons, pressures, strict=True)
    ]
    plate_strain.add_checks(outcome, found, strains, pressures, plate, _strain_in_the_centre(session, analysis, fit))
    outcome.pictures |= strain_pictures.plate(session.out, fields, strains, found, pressures, plate)
    return outcome


def _strain_in_the_centre(session: DemoRun, analysis: AnalysisHandle, fit: PlateFit) -> list[tuple[float, float]]:
    """Read the mean of both normal strains in the plate's centre in every step, with its standard deviation."""
    centre = {"name": "centre", "xy_mm": list(fit.centre_mm)}
    steps = session.client.gauges(analysis, points=[centre], variables=["exx", "eyy"])[1:]
    found = []
    for step in steps:
        exx, eyy = (step.points[0].values[name] for name in ("exx", "eyy"))
        sigmas = [np.nan if v.sigma is None else v.sigma for v in (exx, eyy)]
        assert exx.value is not None
        assert eyy.value is not None
        # their errors hardly go together: a whole window's slopes over column and row do not
        found.append((0.5 * (exx.value + eyy.value), 0.5 * float(np.linalg.norm(sigmas))))
    return found


def _outcome(
    shape: Field,
    fields: list[Field],
    comparisons: list[MotionComparison],
    pressures: list[float],
    plate: CircularPlate,
    fit: PlateFit,
    session: DemoRun,
) -> Outcome:
    outcome = Outcome()
    rows = []
    for result, comparison, pressure in zip(fields, comparisons, pressures, strict=True):
        found = centre_deflection_um(result, fit.centre_mm)
        true = 1e3 * plate.centre_deflection_mm(pressure)
        check = DemoCheck(f"centre deflection at {pressure:g} kPa", "um", found, true, found - true, CENTRE_LIMIT_UM)
        outcome.checks.append(check)
        u, v, w = 1e3 * comparison.rms_mm
        rows.append(
            [
                f"{pressure:.1f}",
                f"{found:.2f}",
                f"{true:.2f}",
                f"{check.error:+.2f}",
                f"{u:.2f}",
                f"{v:.2f}",
                f"{w:.2f}",
                f"{int(result.valid.sum())}/{result.valid.size}",
                str(int(comparison.wrong.sum())),
            ]
        )
    percent = 100.0 * (fit.radius_mm / plate.radius_mm - 1.0)
    outcome.checks.append(
        DemoCheck("radius fitted to Eq. (18)", "mm", fit.radius_mm, plate.radius_mm, percent, RADIUS_LIMIT_PERCENT, "%")
    )
    wrong = sum(int(c.wrong.sum()) for c in comparisons) + int(compare_shape(shape, session.rig, "plate").sum())
    valid = int(shape.valid.sum()) + sum(int(f.valid.sum()) for f in fields)
    outcome.checks.append(DemoCheck("wrong points among the valid", "points", wrong, None, wrong, 0))
    outcome.lines += table(["kPa", "centre um", "true um", "error", "rms u um", "v", "w", "valid", "wrong"], rows)
    outcome.lines += [
        "",
        f"radius by least squares: {fit.radius_mm:.3f} mm, true {plate.radius_mm:.3f} mm ({percent:+.2f} %)",
        f"wrong points among {valid} valid ones: {wrong}",
    ]
    outcome.data = {
        "radius_mm": fit.radius_mm,
        "centre_mm": list(fit.centre_mm),
        "valid_points": valid,
        "error_rms_um": [(1e3 * c.rms_mm).tolist() for c in comparisons],
    }
    return outcome
