"""The simulated world: cameras on their stages before a scene, exposed on demand.

It connects grabbers and controllers. It takes the stages' true positions, renders each camera's view from there, and
adds fresh noise to every exposure. A camera may be knocked (``bump``), and its lens drifts with its exposures if the
rig file has a drift. Brightness is kept per camera, scene and position, so that further frames of a resting rig need
new noise only.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Float32
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.sim.boards.poses import transform_of
from stereorig.sim.catalog import make_scene
from stereorig.sim.optics.lens import warmed
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimCamera, SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.truth import Truth, truth_at

_KEY_MM = 1e-7  # positions closer than this are one: a ten-thousandth of a micrometre
_CACHE_BYTES = 256 << 20
_SHOWN = 16  # images of a scene that come back
_NO_BUMP = (0.0,) * 6


def _six(bump: Sequence[float]) -> tuple[float, ...]:
    try:
        numbers = tuple(float(v) for v in bump)
        transform_of(numbers)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"A bump of {bump!r} is not [rx_deg, ry_deg, rz_deg, x_mm, y_mm, z_mm].",
            code="scene_invalid",
            remedy="Give six numbers.",
        ) from error
    return numbers


class SimWorld:
    """A rig's surroundings; every method may be called from any thread.

    >>> world = SimWorld(SimRig.from_toml("config/sim_paper.toml"), lambda axis: 0.0)
    >>> world.set_scene("plate", load=689.0)
    >>> image = world.expose("cam1", exposure_ms=10.0, gain_db=0.0, rng=np.random.default_rng(1))

    Parameters
    ----------
    rig
        The truth.
    position_mm
        True position of a stage axis by its number.
    threads
        Threads that one rendering may use.
    """

    def __init__(self, rig: SimRig, position_mm: Callable[[int], float], *, threads: int = 1) -> None:
        self._rig = rig
        self._position_mm = position_mm
        self._options = RenderOptions(blur_px=rig.blur_px, threads=threads)
        self._state = threading.Lock()  # scene, tilts and cache; never held while rendering
        self._rendering = {name: threading.Lock() for name in CAMERAS}  # so that no view is rendered twice
        self._scene = make_scene(rig, "grid")
        self._scene_key: tuple[Any, ...] = ("grid", 0.0)
        self._cameras: dict[CameraName, SimCamera] = {name: rig.camera(name) for name in CAMERAS}
        self._bumps: dict[CameraName, tuple[float, ...]] = {}
        self._exposures = dict.fromkeys(CAMERAS, 0)
        self._shown: dict[CameraName, tuple[Float32, tuple[float, float], deque[Any]]] = {}
        self._cache: OrderedDict[tuple[Any, ...], Float32] = OrderedDict()

    @property
    def rig(self) -> SimRig:
        """The rig of the world."""
        return self._rig

    @property
    def scene(self) -> Scene:
        """The scene before the cameras."""
        with self._state:
            return self._scene

    def set_scene(self, name: str, *, load: float = 0.0, **params: Any) -> None:
        """Put another scene, or another state of it, before the cameras; see :func:`stereorig.sim.catalog.make_scene`.

        ``bump_cam1`` and ``bump_cam2``, six numbers [rx_deg, ry_deg, rz_deg, x_mm, y_mm, z_mm], knock a camera at the
        same moment, see :meth:`bump`; the next scenes find it so.
        """
        bumps = {cam: _six(params.pop(f"bump_{cam}")) for cam in CAMERAS if f"bump_{cam}" in params}
        scene = make_scene(self._rig, name, load=load, **params)
        with self._state:
            self._scene = scene
            self._bumps |= bumps
            # the renderings of a state are found again when it returns
            self._scene_key = (name, float(load), *sorted((k, repr(v)) for k, v in params.items()))

    def set_axis_tilt(self, cam: CameraName, tilt_rad: tuple[float, float]) -> None:
        """Misalign a camera's stage axis: turned about the camera's x and y from the optical axis."""
        with self._state:
            self._cameras[cam] = replace(self._cameras[cam], axis_tilt_rad=tilt_rad)

    def bump(
        self,
        cam: CameraName,
        *,
        rotation_deg: Sequence[float] = (0.0, 0.0, 0.0),
        shift_mm: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Knock a camera: from now on its pose differs from the rig file's by this, which replaces an earlier bump.

        Parameters
        ----------
        cam
            Which camera.
        rotation_deg
            Rotation vector about the pinhole, camera's frame: the scene's turn as the camera sees it.
        shift_mm
            Displacement of the scene in the camera's frame.
        """
        six = _six((*rotation_deg, *shift_mm))
        with self._state:
            self._sim_camera(cam)
            self._bumps[cam] = six

    def true_camera(self, cam: CameraName) -> Camera:
        """Return the camera at its stage's present position, with its bump and its drift."""
        with self._state:
            sim = self._sim_camera(cam)
            bump, share = self._bumps.get(cam, _NO_BUMP), self._warmth(cam, sim)
        return self._camera_now(sim, self._position_mm(sim.stage_axis), bump, share)

    def true_scene(self, cam: CameraName) -> Scene:
        """Return the scene where the camera's stage axis has taken it; the same as :attr:`scene` if cameras move."""
        with self._state:
            scene, sim = self._scene, self._sim_camera(cam)
        return self._scene_now(scene, sim, self._position_mm(sim.stage_axis))

    def _warmth(self, cam: CameraName, sim: SimCamera) -> float:
        return sim.warm_up.share(self._exposures[cam], sim.size_px)

    def _camera_now(self, sim: SimCamera, position_mm: float, bump: tuple[float, ...], share: float) -> Camera:
        stage = self._rig.stage
        camera = sim.at(position_mm) if stage.moves == "cameras" else sim.camera
        pose, lens = camera.cam_from_sys, camera.lens
        if stage.moves == "both_cameras":
            pose = pose @ RigidTransform(np.eye(3), stage.travel_mm(sim.dz_mm(position_mm)))
        if bump != _NO_BUMP:
            pose = transform_of(bump) @ pose
        if share:
            warm = sim.warm_up
            lens = warmed(lens, (share * warm.shift_px[0], share * warm.shift_px[1]), share * warm.focal)
        return Camera(lens, pose)

    def _scene_now(self, scene: Scene, sim: SimCamera, position_mm: float) -> Scene:
        stage = self._rig.stage
        if stage.moves != "target":
            return scene
        moved = RigidTransform(np.eye(3), stage.travel_mm(sim.dz_mm(position_mm)))
        return replace(scene, sys_from_body=moved @ scene.sys_from_body)

    def true_pair(self) -> StereoPair:
        """Return the true pair with both stages at their zero: the truth of a calibration."""
        return StereoPair(*(self._rig.camera(name).camera for name in CAMERAS))

    def truth(
        self, xy_px: ArrayLike, name: str, *, load: float = 0.0, reference_load: float = 0.0, **params: Any
    ) -> Truth:
        """Return the truth at camera 1's pixels (..., 2) for a scene's motion between two loads, stages at zero."""
        reference = make_scene(self._rig, name, load=reference_load, **params)
        now = make_scene(self._rig, name, load=load, **params)
        return truth_at(reference, self._rig.cam1.camera, xy_px, now=now)

    def expose(
        self,
        cam: CameraName,
        *,
        exposure_ms: float,
        gain_db: float = 0.0,
        rng: np.random.Generator | None,
        again: bool = False,
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Return an image of the present scene and stage position; with fresh noise unless ``rng`` is None.

        With ``again``, images of a scene that stays come back in turn, for cameras too fast for fresh noise.
        """
        brightness, sim = self._brightness(cam)
        if not again:
            return sim.sensor.expose(brightness, rng, exposure=exposure_ms / sim.exposure_ms, gain_db=gain_db)
        shown, settings, images = self._shown.get(cam, (None, None, deque[Any]()))
        if shown is not brightness or settings != (exposure_ms, gain_db):
            images = deque()
            self._shown[cam] = brightness, (exposure_ms, gain_db), images
        if len(images) < _SHOWN:
            images.append(sim.sensor.expose(brightness, rng, exposure=exposure_ms / sim.exposure_ms, gain_db=gain_db))
        else:
            images.rotate(-1)
        newest: NDArray[np.uint8] | NDArray[np.uint16] = images[-1]
        return newest

    def _sim_camera(self, cam: CameraName) -> SimCamera:
        if cam not in self._cameras:
            raise InputError(f"There is no camera {cam!r}.", code="unknown_camera", remedy="Use cam1 or cam2.")
        return self._cameras[cam]

    def _brightness(self, cam: CameraName) -> tuple[Float32, SimCamera]:
        with self._state:
            sim = self._sim_camera(cam)
        with self._rendering[cam]:
            with self._state:
                scene, state, sim = self._scene, self._scene_key, self._sim_camera(cam)
                bump, share = self._bumps.get(cam, _NO_BUMP), self._warmth(cam, sim)
                self._exposures[cam] += 1
            position = self._position_mm(sim.stage_axis)
            key = (cam, state, round(position / _KEY_MM), sim.axis_tilt_rad, bump, share)
            with self._state:
                known = self._cache.get(key)
                if known is not None:
                    self._cache.move_to_end(key)
            if known is None:
                camera, there = self._camera_now(sim, position, bump, share), self._scene_now(scene, sim, position)
                known = sim.lighting.apply(render(there, camera, sim.size_px, options=self._options))
                known.setflags(write=False)
                self._remember(key, known)
        return known, sim

    def _remember(self, key: tuple[Any, ...], brightness: Float32) -> None:
        with self._state:
            self._cache[key] = brightness
            while len(self._cache) > 2 and sum(a.nbytes for a in self._cache.values()) > _CACHE_BYTES:
                self._cache.popitem(last=False)
