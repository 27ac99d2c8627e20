"""Two GigE cameras in front of the simulated world, and the simulated controller that moves them, as a process.

Aravis' own fake camera speaks GigE Vision on the wire; only its pictures are ours. So the images of a simulated rig go
through the same driver, network and buffers as a real camera's.

Run as ``python gige_sim.py RIG.toml ADDRESS1 ADDRESS2``; prints a line of JSON with the controller's URL when all is
ready, takes ``{"scene": ..., "load": ...}`` lines, and ends with its standard input.
"""

from __future__ import annotations

import ctypes
import json
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.names import CAMERAS, CameraName
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld

_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)  # buffer, data, exposure in us, gain, pixel format


def _library() -> ctypes.CDLL:
    lib = ctypes.CDLL("libaravis-0.8.so.0")
    pointer = ctypes.c_void_p
    lib.arv_gv_fake_camera_new.restype = pointer
    lib.arv_gv_fake_camera_new.argtypes = [ctypes.c_char_p, ctypes.c_char_p]
    lib.arv_gv_fake_camera_is_running.argtypes = [pointer]
    lib.arv_gv_fake_camera_get_fake_camera.restype = pointer
    lib.arv_gv_fake_camera_get_fake_camera.argtypes = [pointer]
    lib.arv_fake_camera_set_fill_pattern.argtypes = [pointer, _FILL, pointer]
    lib.arv_buffer_get_data.restype = pointer
    lib.arv_buffer_get_data.argtypes = [pointer, ctypes.POINTER(ctypes.c_size_t)]
    for name in ("width", "height"):
        getattr(lib, f"arv_buffer_get_image_{name}").argtypes = [pointer]
    return lib


class WorldCamera:
    """One fake GigE camera with the pictures of one simulated camera.

    Parameters
    ----------
    world
        What it sees.
    cam
        Which of the world's cameras it is.
    address
        Address or interface that it listens on.
    """

    def __init__(self, lib: ctypes.CDLL, world: SimWorld, cam: CameraName, address: str) -> None:
        self._lib, self._world, self._cam = lib, world, cam
        self._rng = np.random.default_rng(int(cam[-1]))
        self._exposure_ms = world.rig.camera(cam).exposure_ms
        self._fill = _FILL(self._draw)  # must live as long as the camera
        self._camera = lib.arv_gv_fake_camera_new(address.encode(), f"WORLD-{cam}".encode())
        if not lib.arv_gv_fake_camera_is_running(self._camera):
            raise SystemExit(f"the fake camera does not run on {address}")
        fake = lib.arv_gv_fake_camera_get_fake_camera(self._camera)
        lib.arv_fake_camera_set_fill_pattern(fake, self._fill, None)

    def _draw(self, buffer: int, _data: int, exposure_us: int, _gain: int, _pixel_format: int) -> None:
        lib, size = self._lib, ctypes.c_size_t()
        pixels = self._world.expose(self._cam, exposure_ms=exposure_us / 1000.0, rng=self._rng)
        columns, rows = lib.arv_buffer_get_image_width(buffer), lib.arv_buffer_get_image_height(buffer)
        picture = np.zeros((rows, columns), np.uint8)
        height, width = min(rows, pixels.shape[0]), min(columns, pixels.shape[1])
        picture[:height, :width] = pixels[:height, :width]
        # the buffer was made for this width and height at 8 bit; its size is set only after this call
        ctypes.memmove(lib.arv_buffer_get_data(buffer, ctypes.byref(size)), picture.ctypes.data, picture.nbytes)


def _render_ahead(world: SimWorld, controller: SimESP301, ending: threading.Event) -> None:
    """Render what a camera sees as soon as the stage rests: the fake camera's one thread must not wait for it."""
    before: list[float] = []
    while not ending.wait(0.05):
        now = [controller.true_position_mm(axis) for axis in (1, 2)]
        if now == before:
            for cam in CAMERAS:
                world.expose(cam, exposure_ms=10.0, rng=None)
        before = now


def main(rig_file: str, *addresses: str) -> None:
    """Run until standard input ends."""
    rig = SimRig.from_toml(Path(rig_file))
    controller = SimESP301(axes=2, travel_mm=(-12.0, 12.0), time_scale=2.5)
    world = SimWorld(rig, controller.true_position_mm)
    for cam in CAMERAS:
        world.expose(cam, exposure_ms=10.0, rng=None)  # compiles, and renders at the stage's position
    lib = _library()
    ending = threading.Event()
    threading.Thread(target=_render_ahead, args=(world, controller, ending), daemon=True).start()
    with ControllerServer(controller) as server:
        cameras = [WorldCamera(lib, world, cam, address) for cam, address in zip(CAMERAS, addresses, strict=True)]
        print(json.dumps({"stage": server.url, "cameras": len(cameras)}), flush=True)
        for line in sys.stdin:
            order: dict[str, Any] = json.loads(line)
            world.set_scene(order.pop("scene"), load=order.pop("load", 0.0), **order)
            for cam in CAMERAS:
                world.expose(cam, exposure_ms=10.0, rng=None)
            print(json.dumps({"done": True}), flush=True)
    ending.set()


if __name__ == "__main__":
    main(*sys.argv[1:])
