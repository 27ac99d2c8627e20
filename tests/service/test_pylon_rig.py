"""The service with cameras behind a vendor's own stack: rendered pictures that pylon's emulator plays from files."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tifffile

from stereorig.core.names import CAMERAS, CameraName
from stereorig.server.cli import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.rig.devices import DeviceFinder
from stereorig.server.workflows.service import Service
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.patience import Deadline
from tests.support.pylon_bench import EMULATED, SERIALS, what_is_missing
from tests.support.requirements import missing
from tests.support.service_rig import SMALL, new_test, served, wait_for_job, wait_for_rig

API = "/api/v1"
LOAD_KPA = 400.0


@pytest.fixture
def emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    lacking = what_is_missing()
    if lacking is not None:
        missing(lacking)
    monkeypatch.setenv(EMULATED, "2")


@pytest.fixture
def world(emulator: None, tmp_path: Path) -> Iterator[PlayedWorld]:
    with PlayedWorld(SMALL, tmp_path) as made:
        yield made


def rig_file(world: PlayedWorld) -> str:
    """The simulated rig's file with a vendor's cameras in place of its own."""
    text = SMALL.split("[sim]")[0].replace('url = "sim"', f'url = "{world.url}"\nhome_at_start = true')
    text = text.replace("settle_ms = 0", "settle_ms = 2000")  # pictures are drawn while the stage settles
    text = text.replace('"simulated"\nmax_skew_ms = 1.0', '"real"\ntrigger = "software"\nmax_skew_ms = 1000.0')
    for cam in CAMERAS:
        played = f'{{ TestImageSelector = "Off", ImageFilename = "{world.folders[cam]}", ImageFileMode = "On" }}'
        own = f'driver = "pylon"\ndevice = "{SERIALS[cam]}"\nregion_px = [0, 0, 256, 240]\nfeatures = {played}\n'
        text = text.replace(f"[{cam}]\n", f"[{cam}]\n{own}")
    return text


def test_emulated_cameras_are_listed(emulator: None) -> None:
    found = DeviceFinder(["pylon"]).find(timeout_s=20.0).cameras
    assert [(one.driver, one.device, one.problem) for one in found] == [
        ("pylon", serial, None) for serial in SERIALS.values()
    ]


def test_features_and_values_of_a_camera_that_only_pylon_knows_are_printed(
    emulator: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["devices", "--features", SERIALS["cam1"]]) == 0
    rows = {words[0]: words for words in map(str.split, capsys.readouterr().out.splitlines())}
    assert rows["Width"][1:4] == ["read", "and", "write"]
    assert rows["Width"][-1] == "region_px"
    assert main(["devices", "--dump", SERIALS["cam1"]]) == 0
    kept = json.loads(capsys.readouterr().out)
    assert (kept["vendor"], kept["model"], kept["protocol"]) == ("Basler", "Emulation", "emulated")
    values = {row["name"]: row["value"] for row in kept["features"]}
    assert (values["Width"], values["DeviceModelName"]) == (1024, "CamEmu")
    assert main(["devices", "--features", "0815-9999"]) == 1
    assert "0815-9999 is no camera that answers" in capsys.readouterr().err


def test_a_calibration_load_steps_and_a_live_measurement_of_played_pictures_agree_with_the_truth(
    world: PlayedWorld, tmp_path: Path
) -> None:
    with Service(parse_config(rig_file(world)), tmp_path / "data") as service, served(service) as client:
        wait_for_rig(client)
        accepted = client.post(f"{API}/calibrations", json={"frames": 2}).raise_for_status().json()
        done = wait_for_job(client, accepted["job"])
        assert done["state"] == "succeeded", done["problem"]
        found = client.get(f"{API}/calibrations/{accepted['calibration_id']}").json()
        assert found["verdict"]["level"] == "good", found["verdict"]
        assert [found["provenance"]["cameras"][cam]["serial"] for cam in CAMERAS] == list(SERIALS.values())
        for cam in CAMERAS:
            true = world.world.rig.camera(cam).camera.paper_parameters()
            assert found[cam]["z0_mm"] == pytest.approx(true["z0_mm"], rel=0.01)  # seen under 2 degrees only
        test_id = new_test(client, calibration_id=accepted["calibration_id"])
        for load in (0.0, LOAD_KPA):
            world.show("plate", load)
            client.post(f"{API}/tests/{test_id}/steps", json={"label": f"{load} kPa"}).raise_for_status()
        body = {"region": {"rectangle": [70, 70, 170, 160]}, "subset_px": 25, "spacing_px": 10}
        analysis = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
        done = wait_for_job(client, analysis["job"], 240.0)
        assert done["state"] == "succeeded", done["problem"]
        fields = f"{API}/tests/{test_id}/analyses/{analysis['analysis_id']}/steps/1/fields"
        w_mm, sigma_mm = (_field(client, f"{fields}/{name}") for name in ("w_mm", "sigma_w_mm"))
        xy_px = np.stack(np.meshgrid(np.arange(70.0, 171.0, 10.0), np.arange(70.0, 161.0, 10.0)), axis=-1)
        true_mm = world.world.truth(xy_px, "plate", load=LOAD_KPA).uvw_mm[..., 2]
        assert true_mm.min() < -0.06
        normed = (w_mm - true_mm) / sigma_mm
        # 110 points whose subsets overlap: their mean's and spread's standard deviations are about 0.25 and 0.15
        assert abs(normed.mean()) < 0.8
        assert 0.6 < normed.std() < 1.6
        assert np.abs(normed).max() < 5.0
        now = _live_point(client, test_id, (120, 115))
        for name, true_value in zip(
            ("u_mm", "v_mm", "w_mm"), world.world.truth((120, 115), "plate", load=LOAD_KPA).uvw_mm, strict=True
        ):
            assert abs(now[name]["value"] - true_value) < 4.0 * now[name]["u"], (name, now[name], true_value)


def _field(client: httpx.Client, url: str) -> Any:
    document = client.get(url, params={"format": "json"}).raise_for_status().json()
    return np.array(document["values"], dtype=float)


def _live_point(client: httpx.Client, test_id: str, xy_px: tuple[int, int]) -> dict[str, Any]:
    """Measure live and return the values of a point in the third frame."""
    url = f"{API}/tests/{test_id}/live"
    points = {"points": [{"name": "p1", "xy_px": xy_px}], "silence_ms": 20000}
    client.post(url, json=points).raise_for_status()
    try:
        deadline = Deadline(120.0)
        while True:
            values = client.get(url).raise_for_status().json()["values"]
            if values["number"] >= 3 and values["valid"]:
                return values["gauges"]["p1"]["values"]  # type: ignore[no-any-return]
            assert deadline.left, values
            time.sleep(0.05)
    finally:
        client.post(f"{url}:stop").raise_for_status()


# A simulated rig whose pictures are files, which emulated cameras play, and the simulated controller that moves it.

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
