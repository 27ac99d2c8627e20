"""``stereorig measure`` on a small rig."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.names import CAMERAS
from stereorig.sim.rig import SimRig
from tests.support.requirements import ROOT

SIZE = (230, 200)


ROI = "50,45,180,155"


def small_rig() -> SimRig:
    """The paper's rig with smaller sensors: the same rays, fewer pixels."""
    tables = tomllib.loads((ROOT / "config" / "sim_paper.toml").read_text())
    for name in CAMERAS:
        tables[name]["image_size_px"] = list(SIZE)
        tables["sim"][name] |= {"cx_px": SIZE[0] / 2 + 3.0, "cy_px": SIZE[1] / 2 - 2.0}
    return SimRig.from_dict(tables)


@pytest.fixture(scope="module")
def rig() -> SimRig:
    return small_rig()


def command(folder: Path, results: Path, **changes: str | list[str] | None) -> list[str]:
    options: dict[str, Any] = {
        "cam1": str(folder / "cam1_*.tif"),
        "cam2": str(folder / "cam2_*.tif"),
        "calibration": str(folder / "calibration.json"),
        "roi": ROI,
        "subset": "21",
        "out": str(results),
    }
    options.update(changes)
    arguments = ["measure"]
    for name, value in options.items():
        if value is not None:
            arguments += [f"--{name}", *([value] if isinstance(value, str) else value)]
    return arguments
