"""Poses, hands, stages, bumps and warm-up of the simulated rig, and its views as files."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from stereorig.core.boards import BoardTarget
from stereorig.core.errors import InputError
from stereorig.sim.boards.poses import hand_pose, pose_of, transform_of
from stereorig.sim.catalog import make_scene
from stereorig.sim.optics.lens import image_of
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig, SimStage, WarmUp
from stereorig.sim.world import SimWorld
from tests.support.board_views import (
    camera_pair,
    hand_poses,
    main,
    render_views,
    rig_views,
    sim_target,
    travelled,
    write_views,
)
from tests.support.requirements import ROOT

CONFIG = ROOT / "config"
RIG = SimRig.from_toml(CONFIG / "sim_board.toml")
PAPER = SimRig.from_toml(CONFIG / "sim_paper.toml")
POSE = [4.0, -12.0, 30.0, 1.0, -2.0, 3.0]


def exposed(world: SimWorld, cam: str = "cam1") -> np.ndarray:
    return world.expose(cam, exposure_ms=8.0, rng=None).astype(float)  # type: ignore[arg-type]


def with_stage(**stage: object) -> SimRig:
    return replace(RIG, stage=replace(RIG.stage, **stage))  # type: ignore[arg-type]


def test_a_pose_is_a_rotation_vector_in_degrees_and_a_place_in_the_system_frame() -> None:
    pose = transform_of(POSE)
    np.testing.assert_allclose(pose.rotation, cv2.Rodrigues(np.radians(POSE[:3]))[0], atol=1e-12)
    np.testing.assert_array_equal(pose.translation_mm, POSE[3:])
    np.testing.assert_allclose(pose_of(pose), POSE, atol=1e-10)
    scene = make_scene(RIG, "grid", pose=POSE, translation_mm=[0.0, 0.0, 2.0])
    np.testing.assert_allclose(scene.sys_from_body.translation_mm, [1.0, -2.0, 5.0], atol=1e-12)
    for wrong in ([1.0], [0.0] * 5 + [float("nan")], "six"):
        with pytest.raises(InputError) as caught:
            make_scene(RIG, "grid", pose=wrong)
        assert caught.value.code == "scene_invalid"


def test_the_line_grid_too_is_shown_at_any_angle() -> None:
    turned = render(
        make_scene(PAPER, "grid", pose=[0.0, 0.0, 20.0, 0.5, 0.0, 0.0]), PAPER.cam1.camera, PAPER.cam1.size_px
    )
    nodes = np.swapaxes(PAPER.target.points_mm(PAPER.seed), 0, 1)[4:7, 4:7].reshape(-1, 3)
    c, s = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    there = nodes @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [0.5, 0.0, 0.0]
    for x, y in np.round(PAPER.cam1.camera.project(there).xy).astype(int):
        # lines cross there, of 1 px width under a blur of 0.7 px; between the lines the glass is at 0.9
        assert turned[y, x] < 0.6
    assert turned.max() == pytest.approx(0.9, abs=1e-3)


def test_a_hand_holds_the_board_everywhere_in_both_images_the_same_each_time() -> None:
    cameras, sizes = [RIG.cam1.camera, RIG.cam2.camera], [RIG.cam1.size_px, RIG.cam2.size_px]
    poses = np.array([hand_pose(RIG.target, cameras, sizes, n, seed=RIG.seed) for n in range(40)])
    again = hand_pose(RIG.target, cameras, sizes, 7, seed=RIG.seed)
    np.testing.assert_array_equal(again, poses[7])
    assert np.ptp(poses, axis=0).min() > 5.0
    points = RIG.target.points_mm(RIG.seed)
    seen, tilts, depths = [], [], []
    for pose in poses:
        at = transform_of(pose)
        for camera, size in zip(cameras, sizes, strict=True):
            xy = image_of(camera, at.apply(points))
            assert (xy > 0.0).all()
            assert (xy < np.array(size) - 1.0).all()
        seen.append(image_of(cameras[0], at.apply(points)).reshape(-1, 2))
        tilts.append(np.degrees(np.arccos(at.rotation[2, 2])))
        depths.append(cameras[0].cam_from_sys.apply(at.translation_mm)[2])
    # tilts up to 40 degrees about the rig's own axis, which the system frame's misses by a degree
    assert max(tilts) < 42.0
    assert np.max(tilts) > 30.0
    assert np.ptp(depths) > 0.2 * 200.0
    # corners fall into all parts of the image but those at its rim that the other camera does not see
    cells = np.unique(np.floor(np.concatenate(seen) / [153.0, 128.0]) @ [1, 8])
    assert len(cells) >= 48
    assert make_scene(RIG, "grid", hand=7).sys_from_body.translation_mm == pytest.approx(poses[7, 3:])


def test_every_kind_of_target_can_be_held_before_any_rig() -> None:
    for rig in (RIG, PAPER):
        for kind in ("line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric"):
            scene = make_scene(rig, kind, hand=1, pitch_mm=0.6 if rig is PAPER else 6.0)
            image = render(scene, rig.cam1.camera, rig.cam1.size_px, options=RenderOptions(samples=4))
            assert np.isfinite(image).all()
            assert np.ptp(image) > 0.25  # lines of a fifth of a pixel are pale
    assert (
        make_scene(RIG, "circles", marks=1, size=[7, 5], pitch_mm=5.0, bow_mm=0.1).texture.parameters[0]
        == 5.0005 / 1.0001
    )


@pytest.mark.parametrize(
    "params", [{"hand": -1}, {"hand": 1.5}, {"hand": 1, "pose": POSE}, {"dictionary": "DICT_NONE"}, {"tomato": 1}]
)
def test_a_scene_of_a_target_that_makes_no_sense_is_refused(params: dict[str, object]) -> None:
    with pytest.raises(InputError) as caught:
        make_scene(RIG, "grid", **params)
    assert caught.value.code == "scene_invalid"
    with pytest.raises(InputError):
        make_scene(RIG, "plate", radius_mm="wide")


def test_one_stage_moves_the_target_or_the_pair_along_its_own_direction() -> None:
    direction = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    at = {1: 0.0}
    worlds = [
        SimWorld(with_stage(moves=moves, direction=tuple(direction), scale=1.01), lambda axis: at[axis])
        for moves in ("target", "both_cameras")
    ]
    still = SimWorld(RIG, lambda axis: 0.0)
    for world in worlds:
        world.set_scene("grid", pose=POSE)
    at[1] = 4.0
    moved = np.array(POSE[3:]) + 1.01 * 4.0 * direction
    still.set_scene("grid", pose=[*POSE[:3], *moved])
    for cam in ("cam1", "cam2"):
        for world in worlds:
            # rounding of poses alone: no grey level but at a tie
            assert (exposed(world, cam) != exposed(still, cam)).mean() < 1e-4
    target, pair = worlds
    np.testing.assert_allclose(target.true_scene("cam1").sys_from_body.translation_mm, moved)
    np.testing.assert_allclose(target.true_camera("cam1").centre_sys_mm, RIG.cam1.camera.centre_sys_mm)
    np.testing.assert_allclose(
        pair.true_camera("cam2").centre_sys_mm, RIG.cam2.camera.centre_sys_mm - 1.01 * 4.0 * direction, atol=1e-9
    )


def test_a_single_cameras_stage_may_have_a_wrong_scale() -> None:
    camera = replace(PAPER.cam1, stage_scale=1.002)
    shift = camera.at(5.0).cam_from_sys.translation_mm - camera.camera.cam_from_sys.translation_mm
    np.testing.assert_allclose(shift, [0.0, 0.0, 5.01], atol=1e-12)


def test_a_bump_stays_until_another_and_turns_the_view() -> None:
    world = SimWorld(RIG, lambda axis: 0.0)
    before, other = exposed(world), exposed(world, "cam2")
    world.bump("cam1", rotation_deg=(0.0, 0.2, 0.0), shift_mm=(0.0, 0.0, 0.1))
    pose = world.true_camera("cam1").cam_from_sys
    turn = cv2.Rodrigues(np.radians([0.0, 0.2, 0.0]))[0]
    nominal = RIG.cam1.camera.cam_from_sys
    np.testing.assert_allclose(pose.rotation, turn @ nominal.rotation, atol=1e-12)
    np.testing.assert_allclose(pose.translation_mm, turn @ nominal.translation_mm + [0.0, 0.0, 0.1], atol=1e-12)
    bumped = exposed(world)
    # 0.2 degrees are 2006 * 0.00349 = 7.0 px in the middle of the picture
    shift, _ = cv2.phaseCorrelate(before[300:700, 400:800], bumped[300:700, 400:800])
    assert shift[0] == pytest.approx(7.0, abs=0.2)
    np.testing.assert_array_equal(exposed(world, "cam2"), other)
    world.set_scene("block")
    np.testing.assert_allclose(world.true_camera("cam1").cam_from_sys.rotation, pose.rotation)
    world.set_scene("grid", bump_cam1=[0.0] * 6, bump_cam2=[0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(exposed(world), before)
    assert (exposed(world, "cam2") != other).any()
    for wrong in ([1.0], "hard", [0.0] * 5 + [float("inf")]):
        with pytest.raises(InputError) as caught:
            world.set_scene("grid", bump_cam1=wrong)
        assert caught.value.code == "scene_invalid"


def test_a_camera_warms_with_its_exposures_and_not_with_the_clock() -> None:
    warm = WarmUp(shift_px=(0.4, -0.3), focal=1e-4, frames=5.0)
    rig = replace(RIG, cam1=replace(RIG.cam1, warm_up=warm, size_px=(200, 160)))
    worlds = [SimWorld(rig, lambda axis: 0.0) for _ in range(2)]
    runs = [[exposed(world) for _ in range(4)] for world in worlds]
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (runs[0][0] != runs[0][3]).any()
    share = 1.0 - np.exp(-4.0 / 5.0)
    lens, cold = worlds[0].true_camera("cam1").lens, rig.cam1.camera.lens
    # in steps of 0.002 px
    assert lens.cx_px - cold.cx_px == pytest.approx(0.4 * share, abs=2e-3)  # type: ignore[attr-defined]
    assert lens.cy_px - cold.cy_px == pytest.approx(-0.3 * share, abs=2e-3)  # type: ignore[attr-defined]
    assert lens.fx_px / cold.fx_px - 1.0 == pytest.approx(1e-4 * share, abs=1e-6)  # type: ignore[attr-defined]
    assert worlds[0].true_camera("cam2").lens == rig.cam2.camera.lens
    assert warm.share(10**6, (200, 160)) == pytest.approx(1.0)


def test_a_view_of_a_moving_hand_is_the_mean_over_its_way() -> None:
    window, way = (560, 460, 660, 540), np.array([0.4, 0.2, 0.0])
    smeared = render(
        make_scene(RIG, "grid", pose=POSE, smear_mm=list(way)), RIG.cam1.camera, RIG.cam1.size_px, window=window
    )
    many = []
    for share in (np.arange(40) + 0.5) / 40 - 0.5:
        pose = [*POSE[:3], *(np.array(POSE[3:]) + share * way)]
        many.append(render(make_scene(RIG, "grid", pose=pose), RIG.cam1.camera, RIG.cam1.size_px, window=window))
    # the way is 4 px, and edges are blurred over 1.6 px: four nodes of Gauss leave a hundredth of the contrast
    np.testing.assert_allclose(smeared, np.mean(many, axis=0), atol=0.02)
    assert np.abs(smeared - many[20]).max() > 0.1


def test_a_rig_file_of_boards_that_makes_no_sense_is_refused(tmp_path: Path) -> None:
    text = (CONFIG / "sim_board.toml").read_text()
    for change in (
        ('kind = "charuco"', 'kind = "tomato"'),
        ("size = [9, 6]", ""),
        ("marker_mm = 6.0", "marker_mm = 9.0"),
        ('lens = "opencv"             # or', 'lens = "fisheye" # or'),
        ("k1 = -0.05\n", "k1 = inf\n"),
        ("fx_px = 2006.0\n", ""),
        ('stage_moves = "target"', 'stage_moves = "specimen"'),
        ("stage_direction = [0.012, -0.008, 1.0]", "stage_direction = [0.0, 0.0, 0.0]"),
        ("warm_up_frames = 300.0", "warm_up_frames = 0.0"),
        ("bow_mm = 0.03", "bends_mm = 0.03"),
    ):
        assert change[0] in text
        file = tmp_path / "rig.toml"
        file.write_text(text.replace(*change))
        with pytest.raises(InputError) as caught:
            SimRig.from_toml(file)
        assert caught.value.code == "rig_invalid"
    assert SimRig.from_toml(CONFIG / "sim_paper.toml").stage == SimStage()


def test_rendered_views_know_their_points_and_are_found_by_opencv() -> None:
    target = BoardTarget(kind="checkerboard", size=(9, 6), pitch_mm=7.0, node_tolerance_mm=0.01)
    cameras = camera_pair(seed=4)
    poses = hand_poses(target, cameras, range(2), seed=4)
    views = render_views(sim_target(target, bow_mm=0.05), poses, cameras, seed=4)
    assert [view.name for view in views] == ["000", "001"]
    for view in views:
        for cam, image in view.images.items():
            assert image.dtype == np.uint8
            found, xy = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_ACCURACY)
            assert found
            xy = np.swapaxes(np.asarray(xy).reshape(6, 9, 2), 0, 1)
            error = min((xy - view.points_px[cam], xy[::-1, ::-1] - view.points_px[cam]), key=lambda e: np.abs(e).max())
            assert np.sqrt(np.mean(error**2)) < 0.15  # OpenCV's own on tilted boards of 70 px a square


def test_views_become_a_folder_of_the_command_line(tmp_path: Path) -> None:
    target = BoardTarget(kind="circles", size=(7, 5), pitch_mm=9.0, node_tolerance_mm=0.01)
    cameras = camera_pair(size_px=(320, 256), focal_px=500.0)
    poses, names = travelled([0.0] * 6, [0.0, 2.5], [0.0, 0.1, 1.0])
    views = render_views(target, poses, cameras, size_px=(320, 256), names=names)
    folder = write_views(tmp_path / "views", views, target, cameras, moves="target", lens="opencv5")
    images = sorted(path.name for path in folder.glob("*.tif"))
    assert images == ["cam1_+0.000mm.tif", "cam1_+2.500mm.tif", "cam2_+0.000mm.tif", "cam2_+2.500mm.tif"]
    np.testing.assert_array_equal(tifffile.imread(folder / images[3]), views[1].images["cam2"])
    described = tomllib.loads((folder / "target.toml").read_text())
    assert described == {"kind": "circles", "size": [7, 5], "pitch_mm": 9.0, "node_tolerance_mm": 0.01}
    rig = tomllib.loads((folder / "rig.toml").read_text())
    assert rig["cam2"]["image_size_px"] == [320, 256]
    assert rig["cam1"]["angle_deg"] == pytest.approx(-12.5, abs=2.0)
    assert rig["calibration"] == {"moves": "target", "lens": "opencv5"}


def test_views_of_a_rigs_own_target_are_written_by_a_script(tmp_path: Path) -> None:
    text = (CONFIG / "sim_board.toml").read_text().replace("[1224, 1024]", "[612, 512]")
    (tmp_path / "rig.toml").write_text(text)
    assert main([str(tmp_path / "rig.toml"), str(tmp_path / "out"), "--hand", "1", "--travel", "0,3"]) == 0
    names = {path.stem for path in (tmp_path / "out").glob("cam1*.tif")}
    assert names == {"cam1_000", "cam1_+0.000mm", "cam1_+3.000mm"}
    views = rig_views(SimRig.from_toml(tmp_path / "rig.toml"), travels_mm=[0.0, 3.0])
    way = views[1].sys_from_target.translation_mm - views[0].sys_from_target.translation_mm
    direction = np.array([0.012, -0.008, 1.0]) / np.linalg.norm([0.012, -0.008, 1.0])
    np.testing.assert_allclose(way, 3.0 * 1.0004 * direction, atol=1e-12)
