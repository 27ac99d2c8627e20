"""The rig process of `tests.bench.live.live`: its cameras play pictures that were rendered beforehand."""

from __future__ import annotations

import os
from pathlib import Path

from stereorig.server.rig.process.host import main
from stereorig.sim.world import SimWorld
from tests.bench.live.live import SIZE, START, Playback
from tests.bench.speed.scene import rig_of_size

if __name__ == "__main__":
    playback = Playback(rig_of_size(SIZE), Path(os.environ[START]))
    SimWorld.expose = lambda world, cam, **more: playback.expose(world, cam, **more)  # type: ignore[method-assign,misc,assignment]
    raise SystemExit(main())
