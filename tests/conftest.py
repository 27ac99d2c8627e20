"""Tiers by folder, and fixtures that several test files share.

`unit` mirrors the packages and needs no service, no process and no rendered field; `contract` is one suite over every
backend of cameras and stages; `service` runs the service and the command line; `accuracy` compares rendered scenes and
drawn noise with their truth; `browser` operates the page; `crash` kills, fills, fuzzes and loads. The folder's name is
the marker of its tests. Depth is a second marker, `deep`: long forms that `make test` leaves to `make test-deep`.
"""

from __future__ import annotations

import os
import signal
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

pytest.register_assert_rewrite("tests.support.page_bench")  # its assertions print what they found


TESTS = Path(__file__).parent

# What waits longest begins first, and the many short files fill the workers up at the end
ORDER = ("contract", "crash", "service", "browser", "accuracy", "page", "unit")

# A run that was started in the background ignores Ctrl-C, and what it starts would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test with its tier, which is the folder that it lies in, and what is left to the deep tier."""
    items.sort(key=lambda item: ORDER.index(item.path.relative_to(TESTS).parts[0]))
    for item in items:
        folders = item.path.relative_to(TESTS).parts
        item.add_marker(folders[0])
        if "devices" in folders or "aravis" in item.name:
            item.add_marker("devices")
        normal = item.get_closest_marker("normal_depth")
        if normal is not None and item.callspec.id not in normal.args:  # type: ignore[attr-defined]
            item.add_marker("deep")


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
    from tests.support.page_bench import undrawn, watched

    undrawn(client)
    with watched(chromium, str(client.base_url).rstrip("/")) as made:
        yield made
