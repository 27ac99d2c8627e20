"""Fixtures that several test files share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.support.requirements import ROOT, missing

if TYPE_CHECKING:  # most tests need neither
    import httpx
    from playwright.sync_api import Browser

    from server.workflows.service import Service
    from tests.support.page_bench import Watched

pytest.register_assert_rewrite("tests.support.page_bench")  # its assertions say what they found


# Real programs on the wire, by the real clock, beside what else the machine does: what fails twice more is broken
_AGAINST_THE_CLOCK = frozenset(
    {
        "test_aravis.py",
        "test_camera_contract.py",
        "test_cluster.py",
        "test_connections.py",
        "test_continue_follow.py",
        "test_death.py",
        "test_demo.py",
        "test_doctor.py",
        "test_ending.py",
        "test_event_streams.py",
        "test_exports_api.py",
        "test_fake_gige_bench.py",
        "test_gige_service.py",
        "test_logs.py",
        "test_reader.py",
        "test_rig_pairs.py",
        "test_names_and_clocks.py",
        "test_security.py",
        "test_serial_line.py",
        "test_service_worker.py",
        "test_stage_contract.py",
        "test_stage_http.py",
        "test_stage_lines.py",
        "test_stage_stop.py",
        "test_stage_witnesses.py",
    }
)
_USES_A_SERVICE = frozenset({"client", "service", "page", "chromium"})
# Nothing may be lost once: only what took too long is tried again
_STRICT = frozenset({"test_load.py", "test_real_disks.py", "test_service_kill.py", "test_torture.py", "test_trash.py"})
# Minutes each: begun first, so that nobody waits for them at the end
_LONGEST = ("test_torture.py", "test_fuzz_more.py", "test_fuzz.py", "test_v4l2_in_qemu.py")
_TOO_LONG = ["Timeout", "ConnectError", "ReadError", "is silent", "did not answer"]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest; let tests against other programs be tried again: the machine may stall one of them."""
    items.sort(key=lambda item: _LONGEST.index(item.path.name) if item.path.name in _LONGEST else len(_LONGEST))
    if not config.pluginmanager.hasplugin("rerunfailures"):  # as in the guest of test_v4l2_in_qemu.py
        return
    for item in items:
        name = item.path.name
        if name in _STRICT:
            item.add_marker(pytest.mark.flaky(reruns=1, only_rerun=_TOO_LONG))
        elif name in _AGAINST_THE_CLOCK or _USES_A_SERVICE & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder `shared` that lies beside the checkout, or the one STEREORIG_SHARED names."""
    candidates = [ROOT.parent / "shared", ROOT.parent.parent / "shared"]
    if "STEREORIG_SHARED" in os.environ:
        candidates.insert(0, Path(os.environ["STEREORIG_SHARED"]))
    for folder in candidates:
        if folder.is_dir():
            return folder
    missing("the folder ../shared")
    raise AssertionError


@pytest.fixture(scope="session")
def specimen_dir(shared_dir: Path) -> Path:
    """Real images of the D-shaped tension specimen, with their calibration."""
    folder = shared_dir / "data" / "d_specimen"
    if not (folder / "calibration_dice.xml").is_file():
        missing(f"{folder}")
    return folder


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service on the tiny rig, with an empty data folder of its own."""
    from server.workflows.service import Service
    from tests.support.service_rig import tiny_config

    made = Service(tiny_config(), tmp_path_factory.mktemp("service") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    """A client of that service, its rig connected and homed."""
    from tests.support.service_rig import served, wait_for_rig

    with served(service) as made:
        wait_for_rig(made)
        yield made


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """Debian's Chromium, without a window."""
    from tests.support.page_bench import browser

    with browser() as made:
        yield made


@pytest.fixture
def page(chromium: Browser, client: httpx.Client) -> Iterator[Watched]:
    """A page of its own on the service, watched."""
    from tests.support.page_bench import watched

    with watched(chromium, str(client.base_url).rstrip("/")) as made:
        yield made
