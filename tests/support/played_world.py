"""A simulated rig whose pictures are files, which emulated cameras play, and the simulated controller that moves it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from stereorig.core.names import CAMERAS, CameraName
from stereorig.server.config.rig_file import parse_config
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld

# A camera that plays a folder of one file reads it once; of two it reads each one anew
_FILES = ("a.tif", "b.tif")


class _Stage(SimESP301):
    """A controller at whose arrivals new views are drawn; the rig must let its stages settle for so long."""

    def __init__(self, is_drawn: Callable[[], bool]) -> None:
        super().__init__(axes=2, travel_mm=(-12.0, 12.0), time_scale=2.5)
        self._is_drawn = is_drawn

    def _one(self, text: str) -> str | None:
        answer = super()._one(text)
        if answer == "1" and text.endswith("MD?"):
            self._is_drawn()
        return answer


class PlayedWorld:
    """The world of a simulated rig as picture files, drawn again whenever a stage or the scene has changed.

    Parameters
    ----------
    text
        Rig file.
    folder
        Where ``cam1`` and ``cam2`` are made, the folders that the cameras play.
    """

    def __init__(self, text: str, folder: Path) -> None:
        self._stage = _Stage(self._is_drawn)
        self.world = SimWorld(
            SimRig.from_dict(parse_config(text).model_dump(exclude_none=True)), self._stage.true_position_mm
        )
        self._rng = np.random.default_rng(3)
        self._scene = 0
        self._drawn: tuple[float, ...] | None = None
        self._wanted = threading.Event()
        self._ended = False
        self.folders: dict[CameraName, Path] = {cam: folder / cam for cam in CAMERAS}
        for path in self.folders.values():
            path.mkdir()
        self._draw()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> PlayedWorld:
        self._server = ControllerServer(self._stage)
        self.url = self._server.__enter__().url
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._wanted.set()
        self._thread.join()
        self._server.__exit__(None, None, None)

    def show(self, scene: str, load: float) -> None:
        """Change the scene; returns when it is drawn."""
        self.world.set_scene(scene, load=load)
        self._scene += 1
        self._draw()

    def _state(self) -> tuple[float, ...]:
        return (self._scene, *(self._stage.true_position_mm(axis) for axis in (1, 2)))

    def _is_drawn(self) -> bool:
        if self._drawn == self._state():
            return True
        self._wanted.set()
        return False

    def _run(self) -> None:
        while not self._ended:
            self._wanted.wait()
            self._wanted.clear()
            self._draw()

    def _draw(self) -> None:
        state: Any = None
        while state != self._state():
            state = self._state()
            for cam, folder in self.folders.items():
                for name in _FILES:
                    exposed = self.world.expose(cam, exposure_ms=10.0, rng=self._rng)
                    new = folder.parent / f"{cam}-{name}"
                    tifffile.imwrite(new, exposed)
                    new.replace(folder / name)
        self._drawn = state
