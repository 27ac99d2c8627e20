"""The scenes against textbook numbers, differences, and root finding that shares nothing with the renderer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import fsolve

from stereorig.core.cameras.camera import Camera
from stereorig.sim.catalog import SCENE_NAMES, make_scene
from stereorig.sim.notch import NotchedSheet
from stereorig.sim.panel import PAPER_LOADS_KN, CrackedPanel
from stereorig.sim.plate import PAPER_PRESSURES_KPA, CircularPlate
from stereorig.sim.render import material_points, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.steel import average_roughness_mm, ground_steel
from stereorig.sim.texture import line_grid, speckle
from stereorig.sim.truth import subset_planes, truth_at
from tests.support.requirements import ROOT

CONFIG = ROOT / "config"
PAPER = SimRig.from_toml(CONFIG / "sim_paper.toml")
PANEL = SimRig.from_toml(CONFIG / "sim_panel.toml")
LOADS = {"plate": 689.0, "panel": 48.95, "block": 1.0, "strip": 5.0, "sphere": 1.0}


def pixels(rig: SimRig, n: int = 40, margin: int = 20) -> np.ndarray:
    columns, rows = rig.cam1.size_px
    return np.random.default_rng(7).uniform(margin, [columns - margin, rows - margin], (n, 2))


def test_speckle_covers_half_and_depends_on_its_seed_only() -> None:
    st = np.random.default_rng(0).uniform(-40, 40, (200_000, 2))
    one, same, other = (speckle(diameter_mm=0.14, seed=s).value(st) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.01
    cover = (0.85 - one.mean()) / 0.75
    assert cover == pytest.approx(0.5, abs=0.01)
    # smooth: no jump anywhere, least of all where cells meet
    s = np.linspace(-3, 3, 600_001)
    line = speckle(diameter_mm=0.14, seed=1).value(np.stack([s, 0.3 * s], -1))
    # the steepest rim changes by 0.75 * 1.875 / 0.049 per mm; where two overlap, by up to twice that
    assert np.abs(np.diff(line)).max() < 2 * 0.75 * 1.875 / 0.049 * 1e-5 * np.hypot(1, 0.3)


def test_grid_nodes_miss_by_the_tolerance_and_lines_run_through_them() -> None:
    exact = line_grid(pitch_mm=1.0, lines=(11, 9), line_width_mm=0.03)
    off = line_grid(pitch_mm=1.0, lines=(11, 9), line_width_mm=0.03, node_tolerance_mm=0.004, seed=3)
    np.testing.assert_allclose(exact.nodes_mm[4, 5], 0.0, atol=1e-15)
    error = off.nodes_mm - exact.nodes_mm
    assert 0.0035 < np.abs(error).max() <= 0.004
    # mean distance of a uniform square +-h is 0.765 h: 3.06 um, and 0.087 px at 33 um once a fit has taken its part
    assert np.hypot(*error.reshape(-1, 2).T).mean() == pytest.approx(0.765 * 0.004, rel=0.1)
    # the middle of a segment is dark, half a line width beside it is half dark, a tenth of a millimetre away is bright
    for i, j in ((2, 3), (6, 1), (4, 10)):
        mid = 0.5 * (off.nodes_mm[i, j] + off.nodes_mm[i + 1, j])
        along = off.nodes_mm[i + 1, j] - off.nodes_mm[i, j]
        normal = np.array([along[1], -along[0]]) / np.hypot(*along)
        assert off.value(mid) == pytest.approx(0.1, abs=1e-6)
        assert off.value(mid + 0.015 * normal) == pytest.approx(0.45, abs=1e-3)
        assert off.value(mid + 0.1 * normal) == 0.8
    assert off.value([5.3, 0.0]) == 0.8  # bright glass beyond
    inverse = line_grid(pitch_mm=1.0, lines=(11, 9), line_width_mm=0.03, dark_lines=False)
    assert inverse.value([0.0, 0.5]) > 0.79
    assert inverse.value([0.5, 0.5]) == 0.1


def test_plate_bends_as_equation_18_says() -> None:
    plate = CircularPlate()
    assert PAPER_PRESSURES_KPA[0] == 68.9
    assert len(PAPER_PRESSURES_KPA) == 10
    # EQUATIONS.md: 117 um at 689 kPa
    assert plate.centre_deflection_mm(689.0) == pytest.approx(0.117, abs=5e-4)
    D = 71.0e3 * 0.762**3 / (12 * (1 - 0.334**2))
    r = np.linspace(0, 13.385, 50)
    np.testing.assert_allclose(
        plate.deflection_mm(r, 275.6), 0.2756 * (13.385**2 - r**2) ** 2 / (64 * D), rtol=1e-12, atol=1e-15
    )
    z = plate.surface(275.6).positions(np.stack([r, 0 * r], -1))[:, 2]
    np.testing.assert_allclose(z, -plate.deflection_mm(r, 275.6), atol=1e-15)
    assert (plate.surface(275.6).positions([[14.0, 3.0]]) == [[14.0, 3.0, 0.0]]).all()


@pytest.mark.parametrize("large", [False, True])
def test_the_plates_face_strains_as_its_places_move(large: bool) -> None:
    plate = CircularPlate(large_deflection=large)
    h, surface = 1e-4, plate.surface(551.2)
    for angle in (0.0, 0.4, 2.0):
        r = np.linspace(0.5, 13.0, 26)
        out, round_ = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        at = r[:, None] * out
        # the metric of the face by differences of its positions
        along = [(surface.positions(at + h * d) - surface.positions(at - h * d)) / (2 * h) for d in (out, round_)]
        radial, hoop = plate.face_strain(r, 551.2)
        np.testing.assert_allclose(radial, 0.5 * ((along[0] ** 2).sum(-1) - 1.0), atol=2e-9)
        np.testing.assert_allclose(hoop, 0.5 * ((along[1] ** 2).sum(-1) - 1.0), atol=2e-9)
        np.testing.assert_allclose((along[0] * along[1]).sum(-1), 0.0, atol=2e-9)
    # bending: half the thickness times the deflection's curvatures, stretched where it bulges
    w = [plate.deflection_mm(r + d, 551.2) for d in (-1e-3, 0.0, 1e-3)]
    bent = plate.bending_strain(r, 551.2)
    np.testing.assert_allclose(bent[0], -0.381 * (w[0] - 2.0 * w[1] + w[2]) / 1e-6, atol=1e-8)
    np.testing.assert_allclose(bent[1], -0.381 * (w[2] - w[0]) / 2e-3 / r, atol=1e-8)
    for strain in (plate.face_strain, plate.bending_strain):
        np.testing.assert_array_equal(strain([13.4, 20.0], 551.2), 0.0)


def test_plate_stiffens_as_timoshenko_says() -> None:
    # Timoshenko and Woinowsky-Krieger, art. 101, table 82: edge clamped and held, nu = 0.3: A = 0.471
    assert CircularPlate(poisson=0.3).stiffening == pytest.approx(0.471, abs=1e-3)
    stiff, linear = CircularPlate(large_deflection=True), CircularPlate()
    ratio = stiff.centre_deflection_mm(689.0) / linear.centre_deflection_mm(689.0)
    assert ratio == pytest.approx(1 - 0.012, abs=0.0015)  # EQUATIONS.md: membrane stiffening is near 1.2 %
    assert stiff.centre_deflection_mm(-689.0) == -stiff.centre_deflection_mm(689.0)
    # the held edge does not move
    edge = stiff.surface(689.0).positions([[13.385 * (1 - 1e-9), 0.0]])
    np.testing.assert_allclose(edge, [[13.385, 0.0, 0.0]], atol=1e-7)


def test_panel_opens_straightens_and_buckles() -> None:
    panel = CrackedPanel()
    x = np.linspace(-50, 50, 21)
    for load in PAPER_LOADS_KN:
        lips = [panel.surface(load).positions(np.stack([x, 0 * x], -1), lip) for lip in (1.0, -1.0)]
        opening = 4 * panel.stress_mpa(load) * np.sqrt(50.8**2 - x**2) / panel.youngs_modulus_mpa
        np.testing.assert_allclose(lips[0][:, 1] - lips[1][:, 1], opening, rtol=1e-9)
    # far away: uniaxial tension
    far = panel.surface(44.5).tangents([[3.0, 4000.0]])[0]
    strain = panel.stress_mpa(44.5) / panel.youngs_modulus_mpa
    assert far[1, 1] - 1 == pytest.approx(strain, rel=1e-3)
    assert far[0, 0] - 1 == pytest.approx(-panel.poisson * strain, rel=2e-3)
    # at no load: the bow alone, no motion in the plane
    at_rest = panel.surface(0.0).positions([[20.0, 30.0]])[0]
    np.testing.assert_allclose(at_rest[:2], [20.0, 30.0], atol=1e-12)
    assert panel.bow_at_mm(0.0) > 1.5 * panel.bow_at_mm(4.45) > 3 * panel.bow_at_mm(44.5)
    # buckling: next to nothing below its load, then growing
    assert panel.buckle_at_mm(4.45) < 0.05 < 0.5 < panel.buckle_at_mm(35.6) < panel.buckle_at_mm(48.95)
    y = np.linspace(2, 80, 79)
    out = -panel.surface(48.95).positions(np.stack([0 * y, y], -1))[:, 2]
    assert 15 < y[np.argmax(out)] < 40  # the crest is off the crack


@pytest.mark.parametrize("name", ["steel", "plate", "panel", "strip", "sphere"])
def test_tangents_match_differences(name: str) -> None:
    surface = make_scene(PAPER, name, load=LOADS.get(name, 0.0)).surface
    scale = 60.0 if name == "panel" else 8.0
    st = np.random.default_rng(3).uniform(-scale, scale, (200, 2))
    lip = np.where(st[:, 1] >= 0, 1.0, -1.0)
    h = 1e-5
    for axis in range(2):
        step = np.eye(2)[axis] * h
        difference = (surface.positions(st + step, lip) - surface.positions(st - step, lip)) / (2 * h)
        np.testing.assert_allclose(surface.tangents(st, lip)[..., axis], difference, atol=1e-7)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_pixels_see_the_point_that_projects_onto_them(name: str) -> None:
    rig = PANEL if name == "panel" else PAPER
    scene = make_scene(rig, name, load=LOADS.get(name, 0.0))
    for camera in (rig.cam1.camera, rig.cam2.camera):
        xy = pixels(rig)
        st, lip = material_points(scene, camera, xy)
        assert np.isfinite(st).all()
        back = camera.project(scene.sys_from_body.apply(scene.surface.positions(st, lip)))
        np.testing.assert_allclose(back.xy, xy, atol=1e-6)


def test_plate_truth_agrees_with_a_general_root_finder() -> None:
    reference, loaded = (make_scene(PAPER, "plate", load=p) for p in (0.0, 689.0))
    camera = PAPER.cam1.camera
    xy = pixels(PAPER, 12)
    truth = truth_at(reference, camera, xy, now=loaded)
    D = 71.0e3 * 0.762**3 / (12 * (1 - 0.334**2))
    for k, pixel in enumerate(xy):

        def miss(st: np.ndarray, pixel: np.ndarray = pixel) -> np.ndarray:
            return camera.project(reference.sys_from_body.apply([*st, 0.0])).xy - pixel

        s, t = fsolve(miss, [0.0, 0.0], xtol=1e-12)
        np.testing.assert_allclose(truth.st_mm[k], [s, t], atol=1e-8)
        r = np.hypot(s, t)
        w = 0.689 * (13.385**2 - r**2) ** 2 / (64 * D)
        slope = 0.689 * 4 * r * (13.385**2 - r**2) / (64 * D)  # -dw/dr
        in_plane = 0.381 * slope * np.array([s, t]) / r
        expected = reference.sys_from_body.rotation @ [*in_plane, -w]
        np.testing.assert_allclose(truth.uvw_mm[k], expected, atol=1e-9)
    np.testing.assert_allclose(truth.normal_sys, np.tile([0.0, 0.0, 1.0], (12, 1)), atol=1e-12)


def test_block_truth_is_its_rigid_motion() -> None:
    turn, shift = np.array([0.02, -0.03, 0.4]), np.array([0.3, -0.2, 0.5])
    reference = make_scene(PAPER, "block")
    moved = make_scene(PAPER, "block", load=1.0, translation_mm=shift, rotation_rad=turn)
    truth = truth_at(reference, PAPER.cam1.camera, pixels(PAPER), now=moved)
    angle = np.linalg.norm(turn)
    k = turn / angle
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K  # Rodrigues
    np.testing.assert_allclose(truth.uvw_mm, truth.xyz_mm @ R.T + shift - truth.xyz_mm, atol=1e-12)
    np.testing.assert_allclose(truth.rotation, np.broadcast_to(R, (40, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(truth.stretch, 0.0, atol=1e-12)
    strip = truth_at(
        make_scene(PAPER, "strip"), PAPER.cam1.camera, pixels(PAPER), now=make_scene(PAPER, "strip", load=5.0)
    )
    np.testing.assert_allclose(strip.rotation, np.broadcast_to(np.eye(3), (40, 3, 3)), atol=1e-12)
    # Green's strain of 5 % and -0.33 * 5 %
    np.testing.assert_allclose(
        strip.stretch, np.tile([-0.0165 + 0.0165**2 / 2, 0.05 + 0.05**2 / 2, 0.0], (40, 1)), atol=1e-12
    )


def test_material_keeps_its_brightness() -> None:
    # what camera 1 sees of a material point before and after, each through its own ray
    for name, load in LOADS.items():
        rig = PANEL if name == "panel" else PAPER
        before, after = make_scene(rig, name), make_scene(rig, name, load=load)
        camera = rig.cam1.camera
        truth = truth_at(before, camera, pixels(rig), now=after)
        st, _ = material_points(after, camera, camera.project(truth.xyz_mm + truth.uvw_mm).xy)
        np.testing.assert_allclose(st, truth.st_mm, atol=1e-8)
        np.testing.assert_allclose(after.texture.value(st), before.texture.value(truth.st_mm), atol=1e-5)


def test_crack_shows_as_a_gap_that_grows() -> None:
    # at close range: the panel through the paper rig, 33 um/px, so that 0.2 mm of opening are six pixels
    rig = PAPER
    size = (60, 60)
    p = rig.cam1.camera.paper_parameters()
    p["cx_px"], p["cy_px"] = 30.0 + p["cx_px"] - rig.cam1.camera.project([0, 0, -1.2]).xy[0], 30.0
    dark = []
    for load in (0.0, 4.45, 48.95):
        scene = make_scene(rig, "panel", load=load)
        lips = scene.sys_from_body.apply(scene.surface.positions([[0.0, 0.0], [0.0, 0.0]], [1.0, -1.0]))
        base = Camera.from_paper(**p)
        middle = base.project(lips).xy.mean(0)
        camera = Camera.from_paper(**{**p, "cx_px": p["cx_px"] + 30 - middle[0], "cy_px": p["cy_px"] + 30 - middle[1]})
        image = render(scene, camera, size)
        assert np.isfinite(image).all()
        dark.append(float((image < 0.07).sum()) / size[0])
        opening_px = np.ptp(camera.project(lips).xy[:, 1])
        # paint is never darker than 0.1, the gap is 0.04; beside bright paint the blur lights 1.4 px of each rim
        assert max(opening_px - 2.8, 0.0) <= dark[-1] <= opening_px + 0.05
    assert dark[0] == 0.0
    assert dark[2] > 2.5


def test_steel_has_the_roughness_asked_for_and_a_subset_sees_most_of_it() -> None:
    scene = make_scene(PAPER, "steel")
    assert average_roughness_mm(scene.surface) == pytest.approx(1.775e-3, rel=1e-9)
    assert average_roughness_mm(ground_steel(seed=5, ra_um=0.5)) == pytest.approx(0.5e-3, rel=1e-9)
    x, y = np.meshgrid(np.arange(60, 460, 20), np.arange(80, 400, 20))
    centres = np.stack([x.ravel(), y.ravel()], -1)
    camera = PAPER.cam1.camera
    seen = subset_planes(scene, camera, centres, 21).xyz_mm[:, 2]
    true = truth_at(scene, camera, centres).xyz_mm[:, 2]
    ra_seen, ra_true = (np.mean(np.abs(z - z.mean())) for z in (seen, true))
    assert 0.7 < ra_seen / ra_true < 0.98
    # on a plane the subset's plane is the plane
    flat = make_scene(PAPER, "block", load=1.0)
    plane, exact = subset_planes(flat, camera, centres, 33), truth_at(flat, camera, centres)
    np.testing.assert_allclose(plane.xyz_mm, exact.xyz_mm, atol=1e-9)
    np.testing.assert_allclose(plane.normal_sys, exact.normal_sys, atol=1e-9)


def test_a_sphere_as_a_plane_patch_sees_it_is_off_by_its_curvature() -> None:
    # known for this rig: 1.8 um at 21 px on R = 30 mm
    scene = make_scene(PAPER, "sphere")
    centre = [[256.0, 240.0]]
    camera = PAPER.cam1.camera
    seen, true = subset_planes(scene, camera, centre, 21), truth_at(scene, camera, centre)
    off = np.linalg.norm(seen.xyz_mm - true.xyz_mm)
    assert off == pytest.approx(1.8e-3, abs=0.1e-3)


@pytest.mark.parametrize("file", ["sim_paper.toml", "sim_panel.toml", "sim_modern.toml"])
def test_rigs_see_their_whole_target_at_every_position(file: str) -> None:
    import tomllib

    tables = tomllib.loads((CONFIG / file).read_text())
    rig = SimRig.from_dict(tables)
    n = rig.target.lines[0] - 1
    corners = np.array([[i, j, 0.0] for i in (-1, 1) for j in (-1, 1)]) * 0.5 * n * rig.target.pitch_mm
    plan = tables["calibration"]
    for cam, nominal in ((rig.cam1, tables["cam1"]), (rig.cam2, tables["cam2"])):
        for dz in plan["positions_mm"] + plan["held_out_mm"]:
            assert tables["stage"]["soft_limits_mm"][0] <= dz <= tables["stage"]["soft_limits_mm"][1]
            xy = cam.at(dz).project(corners).xy
            assert (xy > 15).all()
            assert (xy < np.array(cam.size_px) - 15).all()
        true = cam.camera.paper_parameters()
        # the user's values are near the truth, and not the truth
        assert 0.002 < abs(nominal["phd_px"] / true["phd_px"] - 1) < 0.05
        assert 0.1 < abs(nominal["angle_deg"] - np.degrees(true["gamma_rad"])) < 3.0
        assert 3.0 < rig.speckle_mm * true["phd_px"] / true["z0_mm"] < 5.0


def test_a_scene_can_fill_nothing_and_still_render() -> None:
    scene = Scene(
        name="plate",
        surface=CircularPlate().surface(100.0),
        texture=speckle(diameter_mm=0.1, seed=1),
        sys_from_body=make_scene(PAPER, "block", load=1.0, translation_mm=(900.0, 0.0, 0.0)).sys_from_body,
        half_size_mm=(5.0, 5.0),
        background=0.25,
    )
    np.testing.assert_allclose(render(scene, PAPER.cam1.camera, (40, 30)), 0.25, atol=1e-12)


def test_a_notched_sheet_is_in_equilibrium_free_at_its_edge_and_strained_as_asked_far_away() -> None:
    sheet, applied_mpa, h = NotchedSheet(), 100.0, 1e-4
    surface = sheet.surface(applied_mpa)
    modulus, nu = sheet.youngs_modulus_mpa, sheet.poisson

    def stress(st: np.ndarray) -> np.ndarray:
        """Hooke's law in plane stress, from differences of positions."""
        by = [(surface.positions(st + step) - surface.positions(st - step)) / (2 * h) for step in ([h, 0], [0, h])]
        exx, eyy, exy = by[0][:, 0] - 1, by[1][:, 1] - 1, 0.5 * (by[0][:, 1] + by[1][:, 0])
        share = modulus / (1 - nu**2)
        return np.stack([share * (exx + nu * eyy), share * (eyy + nu * exx), modulus / (1 + nu) * exy])

    st = np.random.default_rng(1).uniform(-9, 9, (300, 2))
    st = st[(st[:, 0] / sheet.half_length_mm) ** 2 + (st[:, 1] / sheet.half_width_mm) ** 2 > 1.2]
    k = 0.01
    by_s, by_t = ((stress(st + step) - stress(st - step)) / (2 * k) for step in (np.array([k, 0]), np.array([0, k])))
    assert np.abs(by_s[0] + by_t[2]).max() < 0.02  # MPa/mm, of some 30
    assert np.abs(by_s[2] + by_t[1]).max() < 0.02
    around = np.linspace(0, 2 * np.pi, 41)
    axes = np.array([sheet.half_length_mm, sheet.half_width_mm])
    edge = 1.0001 * axes * np.stack([np.cos(around), np.sin(around)], axis=1)
    normal = edge / axes**2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sxx, syy, sxy = stress(edge)
    assert np.abs(sxx * normal[:, 0] + sxy * normal[:, 1]).max() < 0.2
    assert np.abs(sxy * normal[:, 0] + syy * normal[:, 1]).max() < 0.2
    # Inglis: S (1 + 2 a / b) at the ends
    assert syy[0] == pytest.approx(applied_mpa * (1 + 2 * axes[0] / axes[1]), rel=1e-3)
    np.testing.assert_allclose(stress(np.array([[900.0, 700.0]]))[:, 0], [0, applied_mpa, 0], atol=0.01)
    by_s_mm = (surface.positions(st + np.array([h, 0])) - surface.positions(st - np.array([h, 0]))) / (2 * h)
    np.testing.assert_allclose(surface.tangents(st)[..., 0], by_s_mm, atol=1e-9)
    # a ray meets the material point it comes from, and in the notch nothing
    camera = PAPER.cam1.camera
    scene = Scene(name="notch", surface=surface, texture=speckle(diameter_mm=0.1, seed=1))
    met, _ = material_points(scene, camera, camera.project(surface.positions(st[:20])).xy)
    np.testing.assert_allclose(met, st[:20], atol=1e-8)
    inside, _ = material_points(scene, camera, camera.project(np.zeros((1, 3))).xy)
    assert np.isnan(inside).all()
