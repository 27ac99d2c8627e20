"""The demo's strain and gauges on fields of known truth: independent formulas, drawn noise, missing readings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.cameras.camera import Camera
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField, StrainOptions, surface_strain
from stereorig.server.demo.client import AnalysisHandle
from stereorig.server.demo.compare import MotionComparison
from stereorig.server.demo.drawing import gauges as gauge_pictures
from stereorig.server.demo.drawing import strain as strain_pictures
from stereorig.server.demo.experiments import plate_strain, steel_motion
from stereorig.server.demo.experiments.panel_gauges import (
    CrackOpening,
    Slice,
    crests,
    plane_patch_error_mm,
    read_opening,
    true_panel,
)
from stereorig.server.demo.experiments.panel_strain import panel_strain
from stereorig.server.demo.session import Outcome
from stereorig.server.demo.strain import MICRO, along, as_read, chi_limit, difference, whole_gauges
from stereorig.server.formats.gauges.readings import (
    AreaReading,
    AreaStatistics,
    ExtensometerReading,
    Number,
    PointReading,
    RigidMotionReading,
    StepReadings,
)
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.plate import CircularPlate
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import Truth
from tests.support.demo_field import field_of
from tests.support.requirements import ROOT

PANEL = SimRig.from_toml(ROOT / "config" / "sim_panel.toml")
SUBSET = 21


def plate_field(pressure_kpa: float, noise_mm: float = 0.0) -> tuple[Field, Truth]:
    """The face of the bending plate, every point where the formulas put it, and its truth."""
    flat = field_of(lambda x, y: 0.0 * x, noise_mm=noise_mm)
    xy = flat.xyz_mm[..., :2]
    current = CircularPlate().surface(pressure_kpa).positions(xy)
    uvw = current - flat.xyz_mm
    nothing = np.zeros((*flat.shape, 3))
    truth = Truth(xy, flat.xyz_mm, flat.normal_sys, uvw, np.broadcast_to(np.eye(3), (*flat.shape, 3, 3)), nothing)
    assert flat.uvw_mm is not None
    return dataclasses.replace(flat, uvw_mm=flat.uvw_mm + uvw), truth


def test_a_gauge_on_the_plate_reads_theory_less_what_its_width_takes() -> None:
    plate, pressure = CircularPlate(), 689.0
    field, truth = plate_field(pressure)
    strain = surface_strain(field, StrainOptions(window=9), subset_px=SUBSET)
    read = as_read(field, truth, strain)
    np.testing.assert_allclose(read.strain, strain.strain, atol=1e-15)
    found = plate_strain.plate_strain(
        field,
        strain,
        MotionComparison(truth, np.zeros((*field.shape, 3)), np.zeros(field.shape, bool)),
        pressure,
        plate,
        (0.0, 0.0),
    )
    middle = field.shape[0] // 2
    off = np.delete((found.found - found.theory)[:, middle], middle, axis=1)[:, 4:-4]  # the centre has no direction
    effect = plate_strain.gauge_effect(strain, pressure, plate)
    # half width of 2 mm on a radius of 13.4 mm: w'^2 / 2 is averaged too, and adds a few per cent of that
    assert 10e-6 < effect < 30e-6
    np.testing.assert_allclose(-off, effect, atol=4e-6)
    assert found.off_theory[0].rms == pytest.approx(MICRO * effect, abs=4.0)


def test_strain_along_a_direction_and_its_sigma() -> None:
    rng = np.random.default_rng(5)
    spread = rng.normal(size=(3, 3)) * 1e-5
    covariance = spread @ spread.T
    e = np.array([4e-4, -1e-4, 2e-4])
    drawn = rng.multivariate_normal(e, covariance, 40_000).reshape(200, 200, 3)
    strain = StrainField(
        StrainOptions(),
        10.0,
        SUBSET,
        101.0,
        3.0,
        np.zeros((200, 200), np.int8),
        drawn,
        np.broadcast_to(covariance, (200, 200, 3, 3)),
    )
    for angle in (0.0, 0.7, 2.5):
        n = np.array([np.cos(angle), np.sin(angle)])
        value, sigma = along(strain, 3.0 * n)
        matrix = np.array([[e[0], e[2]], [e[2], e[1]]])
        assert value.mean() == pytest.approx(n @ matrix @ n, abs=4 * sigma[0, 0] / 200)
        assert value.std() / sigma[0, 0] == pytest.approx(1.0, abs=0.02)
        off = difference(value, np.full_like(value, n @ matrix @ n), sigma, strain.valid)
        assert off.chi == pytest.approx(1.0, abs=0.02)
        assert off.rms == pytest.approx(off.reported, rel=0.02)
    assert whole_gauges(strain).sum() == 192**2
    assert 1.0 < chi_limit(strain) < 1.2
    assert np.isnan(difference(value, value, sigma, ~strain.valid).rms)


def test_crests_are_found_on_both_sides_of_the_crack_and_past_missing_places() -> None:
    at = np.arange(-80.0, 81.0, 4.0)
    height = np.where(at < 0.0, 0.9 - 1e-3 * (at + 23.0) ** 2, 0.7 - 2e-3 * (at - 31.0) ** 2)
    height[[3, 20, 21, 28]] = np.nan
    left, right = crests(at, height)
    assert (left.height_mm, left.at_mm) == pytest.approx((0.9, -23.0))
    assert (right.height_mm, right.at_mm) == pytest.approx((0.7, 31.0))


def test_a_plane_patch_flattens_a_crest_by_half_its_curvature_times_the_subsets_second_moment() -> None:
    camera: Camera = PANEL.cam1.camera
    xy = np.array([[265.0, 180.0], [320.0, 290.0]])
    found = plane_patch_error_mm(PANEL, camera, xy, 48.95, SUBSET)
    d, w = 4.0, {}
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            w[dx, dy] = -true_panel(PANEL, xy + d * np.array([dx, dy]), 48.95).uvw_mm[..., 2]
    bend = (w[1, 0] + w[-1, 0] + w[0, 1] + w[0, -1] - 4.0 * w[0, 0]) / d**2
    np.testing.assert_allclose(found, 0.5 * bend * (SUBSET**2 - 1) / 12.0, rtol=0.03)
    assert found[0] < -0.005  # mm: several times the noise of w


def ends_of(request: dict[str, Any]) -> np.ndarray:
    return np.array([[g["a_px"], g["b_px"]] for g in request["extensometers"]])


def test_the_cracks_opening_is_read_over_it_and_missing_readings_stay_missing(tmp_path: Path) -> None:
    panel, loads = CrackedPanel(), [35.6, 48.95]
    half = np.sqrt(0.5)
    ends = np.array([[-half, half], [half, -half]]) * panel.half_crack_mm
    crack = np.asarray(PANEL.cam1.camera.project(np.column_stack([ends, [-panel.bow_mm] * 2])).xy)

    class Client:
        def gauges(self, _analysis: AnalysisHandle, **request: Any) -> list[StepReadings]:
            xy = ends_of(request)
            steps = [StepReadings(0, "shape", "", None)]  # the reference
            for load in loads:
                truth = true_panel(PANEL, xy, load)
                before, after = truth.xyz_mm, truth.xyz_mm + truth.uvw_mm
                long = [np.linalg.norm(p[:, 1] - p[:, 0], axis=-1) for p in (before, after)]
                value = [Number(float(v), 0.002, "mm") for v in long[1] - long[0] + 0.001]
                value[3] = Number(None, None, "mm")
                w = truth.uvw_mm[..., 2].ravel()
                over = [ExtensometerReading("e", (0, 0), (0, 0), "", {"elongation_mm": v}) for v in value]
                at = [PointReading("p", (0, 0), "", {"w_mm": Number(float(v), 0.003, "mm")}) for v in w]
                steps.append(StepReadings(1, "displacement", "", load, extensometers=over, points=at))
            return steps

    session: Any = SimpleNamespace(client=Client(), rig=PANEL, out=tmp_path)
    found = read_opening(session, AnalysisHandle("t", "a"), crack, panel, loads)
    assert np.isnan(found.found[:, 3]).all()
    kept = np.delete(found.found - found.true, 3, axis=1)
    np.testing.assert_allclose(kept, 0.001, atol=1e-12)
    np.testing.assert_allclose(found.parting, found.parting_true, atol=1e-12)
    middle = len(found.position) // 2
    np.testing.assert_allclose(
        found.lips[:, middle], [4 * panel.stress_mpa(q) * 50.8 / 73.1e3 for q in loads], rtol=1e-3
    )
    assert (found.lips[:, [0, -1]] == 0.0).all()
    # a few per cent more than the lips, for what the sheet stretches on 12 mm; next to nothing ahead of the tips
    assert (found.true[:, middle] / found.lips[:, middle] < 1.06).all()
    assert (found.true[:, 0] < 0.15 * found.true[:, middle]).all()


def test_a_gauge_over_the_crack_would_be_seen() -> None:
    """A strain that takes the opening for strain is off by what the demo's limit is a tenth of."""
    load = 48.95
    x, y = np.meshgrid(np.arange(120.0, 421.0, 10.0), np.arange(120.0, 361.0, 10.0))
    truth = true_panel(PANEL, np.stack([x, y], axis=-1), load)
    zero, shape = np.zeros_like(x), x.shape
    field = dataclasses.replace(
        field_of(lambda a, b: 0.0 * a),
        x_px=x,
        y_px=y,
        status=np.zeros(shape, np.int8),
        xyz_mm=truth.xyz_mm,
        normal_sys=truth.normal_sys,
        theta_rad=zero,
        phi_rad=zero,
        zp_mm=zero,
        zncc=np.ones((*shape, 3)),
        epipolar_px=zero,
        iterations=np.zeros(shape, np.int32),
        noise_grey=zero,
        covariance=np.broadcast_to(np.eye(6) * 1e-6, (*shape, 6, 6)),
        uvw_mm=truth.uvw_mm,
        rotation_rad=np.zeros((*shape, 3)),
        stretch=np.zeros((*shape, 3)),
    )
    over = surface_strain(field, StrainOptions(window=9), subset_px=SUBSET)  # no crack was drawn
    nothing = MotionComparison(truth, np.zeros((*shape, 3)), np.zeros(shape, bool))
    found = panel_strain(field, over, nothing, 0.2)
    assert found.beside_points.rms > 2.0 * 0.1 * found.over


def test_a_rigid_motions_truth_is_told_about_the_points_middle() -> None:
    name, shift, degrees = steel_motion.MOTIONS[2]
    flat = field_of(lambda x, y: 0.0 * x)
    R = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
    moved = dataclasses.replace(flat, uvw_mm=flat.xyz_mm @ R.T + np.array(shift) - flat.xyz_mm)
    strain = surface_strain(moved, StrainOptions(window=9), subset_px=SUBSET)
    centre = np.array([1.0, -2.0, 0.1])
    d = R @ centre + np.array(shift) - centre
    vector = np.radians(degrees)
    values = {f"rotation_{a}_rad": Number(vector[k] + 1e-6, 1e-6, "rad") for k, a in enumerate("xyz")}
    values |= {f"translation_{a}_mm": Number(d[k] - 1e-4, 1e-4, "mm") for k, a in enumerate("xyz")}
    area = {f"{c}_mm": AreaStatistics("mm", 9, 0.0, 0.0, 1e-4, 1e-4, None, None) for c in "uvw"}
    area |= {name: AreaStatistics("1", 9, 2e-6, 1e-6, 1e-5, 1e-5, None, None) for name in ("exx", "eyy", "exy")}
    long = Number(2e-4, 1e-4, "mm")
    step = StepReadings(
        1,
        "displacement",
        "",
        None,
        rigid_motion=RigidMotionReading(values, centre.tolist(), [], 9, 0.0, 1.0),
        extensometers=[ExtensometerReading("e", (0, 0), (0, 0), "", {"elongation_mm": long})],
        areas=[AreaReading("all", 9, 9, "", area)],
    )
    one = steel_motion._moved((name, shift, degrees), step, strain)
    np.testing.assert_allclose(one.found - one.true, [1e-6] * 3 + [-1e-4] * 3, rtol=1e-9)
    np.testing.assert_allclose(one.false_mean, 2.0)
    outcome = Outcome()
    steel_motion.add_checks(outcome, [one], [strain])
    assert all(check.passed for check in outcome.checks)
    stretched = dataclasses.replace(strain, strain=strain.strain + 3e-5)
    outcome = Outcome()
    far = dataclasses.replace(one, found=one.found + 1e-3, elongation_mm=np.array([5e-4]))
    steel_motion.add_checks(outcome, [dataclasses.replace(far, false_mean=np.full(3, 30.0))], [stretched])
    assert [check.passed for check in outcome.checks] == [False, False, False, False, True]


def test_pictures_of_gauges_are_drawn_with_readings_missing(tmp_path: Path) -> None:
    pressures = [344.5, 689.0]
    plate = CircularPlate()
    fields, strains, found = [], [], []
    for q in pressures:
        field, truth = plate_field(q, noise_mm=2e-4)
        status = field.status.copy()
        status[3:6, 4] = 6
        field = dataclasses.replace(field, status=status)
        strain = surface_strain(field, StrainOptions(window=9), subset_px=SUBSET)
        comparison = MotionComparison(truth, np.zeros((*field.shape, 3)), np.zeros(field.shape, bool))
        fields.append(field)
        strains.append(strain)
        found.append(plate_strain.plate_strain(field, strain, comparison, q, plate, (0.0, 0.0)))
    outcome = Outcome()
    plate_strain.add_checks(outcome, found, strains, pressures, plate, [(5e-4, 2e-5), (9.8e-4, 2e-5)])
    assert [check.passed for check in outcome.checks] == [True] * 5
    drawn = strain_pictures.plate(tmp_path, fields, strains, found, pressures, plate)
    positions = np.array([-1.35, -0.5, 0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.35])
    some = np.full((2, 9), 0.1)
    some[0, 3] = np.nan
    drawn |= gauge_pictures.opening(tmp_path, CrackOpening(positions, *[some] * 7), [1.0, 2.0], 50.8)
    line = Slice(np.zeros((9, 2)), 40.0 * positions, some, some, some)
    drawn |= gauge_pictures.buckle(tmp_path, line, line, [1.0, 2.0])
    motion = steel_motion.Moved("shifted", *[np.zeros(6)] * 4, 1.0, *[np.zeros(1)] * 2, *[np.zeros(3)] * 5, 1.0, {})
    drawn |= gauge_pictures.moved(tmp_path, fields, strains, [motion, motion])
    assert len(drawn) == 5
    for name in drawn:
        assert (tmp_path / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
