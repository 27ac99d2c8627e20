"""Views of calibration targets rendered by the simulation, with the true places of their points, as arrays or files.

As a script it writes a folder of views of a simulated rig, for the command line::

    python -m tests.support.board_views config/sim_board.toml views/ --hand 20 --travel 0,5,10
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget
from stereorig.core.cameras.camera import Camera, RigidTransform, angles_from_rotation, rotation_from_angles
from stereorig.core.cameras.lens import LensModel
from stereorig.core.names import CAMERAS, CameraName
from stereorig.core.target import GridTarget
from stereorig.sim.boards.pattern import BEHIND
from stereorig.sim.boards.poses import hand_pose, pose_of, transform_of
from stereorig.sim.boards.target import SimTarget
from stereorig.sim.optics.lens import SimLens, core_lens, flat_lens, image_of
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.sensor import Sensor
from stereorig.sim.world import SimWorld

SIZE_PX = (1224, 1024)
ORDINARY = {"k1": -0.05, "k2": 0.02, "p1": 2e-4, "p2": -3e-4}
# 2 grey levels of 255 at mid-scale, as of an industrial camera
SENSOR = Sensor(bit_depth=8, full_well_e=10500.0, read_noise_e=60.0)


@dataclass(frozen=True)
class ViewPair:
    """One view of both cameras.

    Attributes
    ----------
    name
        Middle of the files' names: ``000`` for a free pose, ``+5.000mm`` for a travel.
    sys_from_target
        True pose.
    images
        By camera.
    points_px
        By camera, (columns, rows, 2): true images of the points, in ``BoardTarget.points_mm``'s order.
    points_mm
        (columns, rows, 3) true points with the maker's errors, system frame.
    """

    name: str
    sys_from_target: RigidTransform
    images: dict[CameraName, NDArray[np.uint8] | NDArray[np.uint16]]
    points_px: dict[CameraName, Float]
    points_mm: Float


def camera_pair(
    *,
    angle_deg: float = 25.0,
    distance_mm: float = 200.0,
    focal_px: float = 2000.0,
    size_px: tuple[int, int] = SIZE_PX,
    distortion: Mapping[str, float] = ORDINARY,
    seed: int = 0,
) -> tuple[Camera, Camera]:
    """Return two cameras that look at the origin from both sides, X_sys to the right; a little off, by the seed.

    Parameters
    ----------
    angle_deg, distance_mm
        Between the axes, and from the pinholes to the origin.
    focal_px, size_px
        Focal length and image size.
    distortion
        ``k1`` ... ``k6``, ``p1``, ``p2`` in OpenCV's sense; empty for a pinhole.
    seed
        Of the departures from the ideal arrangement: a per cent, a degree, a hundredth of the image.
    """
    rng = np.random.default_rng(seed)
    cameras = []
    for side in (-1.0, 1.0):
        focal = focal_px * (1.0 + rng.uniform(-0.01, 0.01))
        centre = 0.5 * (np.asarray(size_px) - 1.0) + rng.uniform(-0.01, 0.01, 2) * np.asarray(size_px)
        lens = core_lens(SimLens(fx_px=focal, fy_px=focal, cx_px=centre[0], cy_px=centre[1], **distortion))
        turn = np.radians([0.0, 0.0, 0.5 * side * angle_deg]) + np.radians(rng.uniform(-1.0, 1.0, 3))
        at = np.array([*rng.uniform(-0.005, 0.005, 2), 1.0 + rng.uniform(-0.01, 0.01)]) * distance_mm
        cameras.append(Camera(lens, RigidTransform(rotation_from_angles(*turn), at)))
    return cameras[0], cameras[1]


def sim_target(target: BoardTarget | GridTarget, **faults: Any) -> SimTarget:
    """Return the simulation's form of a target; ``faults`` are attributes of :class:`SimTarget` (``bow_mm`` ...)."""
    if isinstance(target, GridTarget):
        own: dict[str, Any] = {
            "lines": target.lines,
            "line_width_mm": target.line_width_mm,
            "dark_lines": target.dark_lines,
        }
    else:
        own = {"kind": target.kind, "size": target.size, "dictionary": target.dictionary}
        own |= {} if target.marker_mm is None else {"marker_mm": target.marker_mm}
    own["node_tolerance_mm"] = target.node_tolerance_mm
    return SimTarget(pitch_mm=target.pitch_mm).changed(own | faults)


def hand_poses(
    target: BoardTarget | GridTarget | SimTarget,
    cameras: Sequence[Camera],
    numbers: Iterable[int],
    *,
    size_px: tuple[int, int] = SIZE_PX,
    seed: int = 0,
) -> list[tuple[float, ...]]:
    """Return a hand's poses, see :func:`stereorig.sim.boards.poses.hand_pose`."""
    held = target if isinstance(target, SimTarget) else sim_target(target)
    return [hand_pose(held, cameras, [size_px] * len(cameras), n, seed=seed) for n in numbers]


def render_views(
    target: BoardTarget | GridTarget | SimTarget,
    poses: Sequence[Sequence[float]],
    cameras: Sequence[Camera],
    *,
    size_px: tuple[int, int] = SIZE_PX,
    seed: int = 0,
    names: Sequence[str] | None = None,
    sensor: Sensor = SENSOR,
    noise: bool = True,
    blur_px: float = 0.7,
    threads: int = 1,
) -> list[ViewPair]:
    """Render views of a target in poses ``[rx_deg, ry_deg, rz_deg, x_mm, y_mm, z_mm]``, see `.boards.poses`.

    Parameters
    ----------
    target
        With its faults: use :func:`sim_target` for those.
    poses
        One a view.
    cameras
        cam1 and cam2, true; or cam1 alone.
    size_px
        Of the images.
    seed
        Of the maker's errors and of the noise.
    names
        Middles of the files' names; ``000``, ``001`` ... if left out.
    sensor, noise
        Bit depth and noise; ``noise`` False leaves it out.
    blur_px
        Lens blur.
    threads
        Threads of the renderer.
    """
    held = target if isinstance(target, SimTarget) else sim_target(target)
    texture, surface, points = held.texture(seed), held.surface(), np.swapaxes(held.points_mm(seed), 0, 1)
    background = BEHIND if held.background is None else held.background
    rng = np.random.default_rng([seed, 1])
    views = []
    for n, pose in enumerate(poses):
        at = transform_of(pose)
        scene = Scene(name=held.kind, surface=surface, texture=texture, sys_from_body=at, background=background)
        xyz = at.apply(points)
        images, true = {}, {}
        for name, camera in zip(CAMERAS, cameras, strict=False):
            brightness = render(scene, camera, size_px, options=RenderOptions(blur_px=blur_px, threads=threads))
            images[name] = sensor.expose(brightness, rng if noise else None)
            true[name] = image_of(camera, xyz)
        views.append(ViewPair(f"{n:03d}" if names is None else names[n], at, images, true, xyz))
    return views


def travelled(
    pose: Sequence[float], travels_mm: Sequence[float], direction: Sequence[float]
) -> tuple[list[tuple[float, ...]], list[str]]:
    """Return poses of a target that one stage moves from ``pose`` along ``direction`` (system frame), and the names."""
    start, way = transform_of(pose), np.asarray(direction) / np.linalg.norm(direction)
    poses = [pose_of(RigidTransform(start.rotation, start.translation_mm + dz * way)) for dz in travels_mm]
    return poses, [travel_name(dz) for dz in travels_mm]


def travel_name(dz_mm: float) -> str:
    """Return the middle of a file's name for a travel, as ``+5.000mm``."""
    return f"{dz_mm:+.3f}mm"


def rig_views(
    rig: SimRig, *, hand: Iterable[int] = (), travels_mm: Iterable[float] = (), seed: int = 0
) -> list[ViewPair]:
    """Return views of a simulated rig's own target: in a hand, and at rest with the stage at travels."""
    position = {"mm": 0.0}
    world = SimWorld(rig, lambda axis: position["mm"])
    rng = np.random.default_rng([seed, 1])
    points = np.swapaxes(rig.target.points_mm(rig.seed), 0, 1)

    def taken(name: str) -> ViewPair:
        images, true = {}, {}
        at = world.true_scene("cam1").sys_from_body
        for cam in CAMERAS:
            # with drift, the camera of this exposure
            camera = world.true_camera(cam)
            images[cam] = world.expose(cam, exposure_ms=rig.camera(cam).exposure_ms, rng=rng)
            true[cam] = image_of(camera, at.apply(points))
        return ViewPair(name, at, images, true, at.apply(points))

    views = []
    for n in hand:
        world.set_scene("grid", hand=n)
        views.append(taken(f"{n:03d}"))
    world.set_scene("grid")
    for dz in travels_mm:
        position["mm"] = rig.cam1.stage_zero_mm + rig.cam1.stage_sign * dz
        views.append(taken(travel_name(dz)))
    return views


def write_views(
    folder: Path,
    views: Sequence[ViewPair],
    target: BoardTarget | GridTarget | SimTarget,
    cameras: Sequence[Camera],
    *,
    moves: str | None = None,
    lens: str | None = None,
    nominal: bool = True,
    calibration: Mapping[str, str] | None = None,
) -> Path:
    """Write ``cam1_<name>.tif`` ..., ``target.toml`` and ``rig.toml`` into a folder; return it.

    Parameters
    ----------
    folder
        Made if it is not there.
    views, target, cameras
        As rendered. Cameras are described by their nominal values, rounded as an engraving is.
    moves, lens
        Keys of ``[calibration]``; left out where None.
    nominal
        False leaves angle and stand-off out, which free poses do not need.
    calibration
        Further keys of ``[calibration]`` with their TOML text.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        for name, image in view.images.items():
            tifffile.imwrite(folder / f"{name}_{view.name}.tif", image, photometric="minisblack")
    (folder / "target.toml").write_text(target_text(target), encoding="utf-8")
    size = views[0].images["cam1"].shape[::-1]
    text = rig_text(cameras, (size[0], size[1]), nominal=nominal)
    keys = {key: f'"{value}"' for key, value in (("moves", moves), ("lens", lens)) if value is not None}
    keys |= dict(calibration or {})
    if keys:
        text += "\n[calibration]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return folder


def target_text(target: BoardTarget | GridTarget | SimTarget) -> str:
    """Return ``target.toml``: what a user knows of the target, without its faults."""
    own = target if isinstance(target, SimTarget) else sim_target(target)
    lines = [f"pitch_mm = {own.pitch_mm!r}", f"node_tolerance_mm = {own.node_tolerance_mm!r}"]
    if own.kind == "line_grid":
        lines += [f"lines = {list(own.lines)}", f"line_width_mm = {own.line_width_mm!r}"]
        lines += [f"dark_lines = {'true' if own.dark_lines else 'false'}"]
    else:
        lines = [f'kind = "{own.kind}"', f"size = {list(own.size)}", *lines]
    if own.kind == "charuco":
        lines += [f"marker_mm = {own.marker_mm!r}", f'dictionary = "{own.dictionary}"']
    return "\n".join(lines) + "\n"


def rig_text(cameras: Sequence[Camera], size_px: tuple[int, int], *, nominal: bool = True) -> str:
    """Return the cameras' part of ``rig.toml``: focal length to a per cent, angle to a degree, stand-off likewise."""
    text = ""
    for name, camera in zip(CAMERAS, cameras, strict=True):
        fx, fy = focal_lengths_px(camera.lens)
        gamma = np.degrees(angles_from_rotation(camera.cam_from_sys.rotation)[2])
        text += f"[{name}]\nimage_size_px = [{size_px[0]}, {size_px[1]}]\nphd_px = {float(f'{fx:.2g}')}\n"
        text += f"aspect = {round(fy / fx, 4)}\n"
        if nominal:
            text += f"standoff_mm = {float(f'{camera.cam_from_sys.translation_mm[2]:.2g}')}\n"
            text += f"angle_deg = {float(round(gamma))}\n"
    return text


def focal_lengths_px(lens: LensModel) -> tuple[float, float]:
    """Return a lens's focal lengths along rows and columns."""
    flat = flat_lens(lens)
    return float(flat[1]), float(flat[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write views of a simulated rig to a folder."""
    parser = argparse.ArgumentParser(description="Write views of a simulated rig's target to a folder.")
    parser.add_argument("rig", type=Path, help="rig file of a simulated rig")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hand", type=int, default=0, help="number of views of the target in a hand")
    parser.add_argument("--travel", default="", help="travels of the stage in mm, as 0,5,10")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    options = parser.parse_args(arguments)
    rig = SimRig.from_toml(options.rig)
    travels = [float(v) for v in re.split(r"[,\s]+", options.travel) if v]
    views = rig_views(rig, hand=range(options.hand), travels_mm=travels, seed=options.seed)
    moves = "free" if not travels else rig.stage.moves
    write_views(options.folder, views, rig.target, [rig.cam1.camera, rig.cam2.camera], moves=moves)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
