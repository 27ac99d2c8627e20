"""Tiers by folder, and fixtures that several test files share.

`unit` mirrors the packages and needs no service, no process and no rendered field; `contract` is one suite over every
backend of cameras and stages; `service` runs the service and the command line; `accuracy` compares rendered scenes and
drawn noise with their truth; `browser` operates the page; `crash` kills, fills, fuzzes and loads. The folder's name is
the marker of its tests. Depth is a second marker, `deep`: long forms that `make test` leaves to `make test-deep`.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from stereorig.server.base.priority import go_on, hurry
from tests.support.container import unmount_leftovers
from tests.support.patience import busy
from tests.support.requirements import ROOT, missing

if TYPE_CHECKING:  # most tests need neither
    import httpx
    from playwright.sync_api import Browser

    from stereorig.server.workflows.service import Service
    from tests.support.page_bench import Watched

pytest.register_assert_rewrite("tests.support.page_bench")  # its assertions print what they found


TESTS = Path(__file__).parent

# Every process loads all tests, and with them the whole program: the garbage collector took a third of that time, and
# went through all of it again later
hurry()

# What waits longest begins first, and the many short files fill the workers up at the end
ORDER = ("contract", "crash", "service", "browser", "accuracy", "page", "unit")

# Tiers whose services have no compute worker until a task needs one, see `worker_with_its_first_task`
LAZY_WORKER = ("contract", "service")

# Of the deep tier, files of minutes begin first: one of them would be left over at the end on a single core. A worker
# takes its next file when two tests are left of its own, and would keep a long one waiting: a short one is the fourth
DEEP_FIRST = (
    "crash/test_torture.py",
    "crash/test_fuzz_more.py",
    "accuracy/test_coverage_chain.py",
    "accuracy/test_prefilter.py",
    "accuracy/test_common_coverage.py",
    "unit/core/test_calibration_compare.py",
    "service/cli/test_demo.py",
)

# A run that was started in the background ignores Ctrl-C, and what it starts would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure() -> None:
    """Free the temporary folders of killed runs, which pytest deletes at the end of this one."""
    if "PYTEST_XDIST_WORKER" not in os.environ and os.geteuid() == 0:
        unmount_leftovers()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Of the deep tier, do not load the nine files in ten that have none of its tests: every worker would."""
    if config.option.markexpr == "deep" and collection_path.match("test_*.py"):
        return True if re.search(r"\bdeep\b|\bnormal_depth\b", collection_path.read_text("utf-8")) is None else None
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark every test with its tier, which is the folder that it lies in, and what is left to the deep tier."""
    first = DEEP_FIRST if config.option.markexpr == "deep" else ()

    def place(item: pytest.Item) -> tuple[int, int]:
        path = item.path.relative_to(TESTS)
        early = first.index(path.as_posix()) if path.as_posix() in first else len(first)
        return early, ORDER.index(path.parts[0])

    items.sort(key=place)
    for item in items:
        folders = item.path.relative_to(TESTS).parts
        item.add_marker(folders[0])
        if "devices" in folders or "aravis" in item.name:
            item.add_marker("devices")
        normal = item.get_closest_marker("normal_depth")
        if normal is not None and item.callspec.id not in normal.args:  # type: ignore[attr-defined]
            item.add_marker("deep")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile the kernels before the first long test of a service: a child that compiles for minutes is no failure."""
    go_on()
    if "PYTEST_XDIST_WORKER" in os.environ or session.config.option.collectonly:
        return  # `make test-deep` has them compiled
    tiers = {item.path.relative_to(TESTS).parts[0] for item in session.items if item.get_closest_marker("deep")}
    if tiers & {"crash", "service"}:
        subprocess.run([sys.executable, "-m", "tests.support.kernels"], cwd=ROOT, check=True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Let a test take longer the busier the machine is: its limit is for one that hangs, not for a slow one."""
    marker = item.get_closest_marker("timeout")
    seconds = float(marker.args[0] if marker is not None and marker.args else item.config.getini("timeout"))
    patience = busy() * (4.0 if item.get_closest_marker("deep") else 1.0)
    if patience > 1.0:
        item.add_marker(pytest.mark.timeout(seconds * patience), append=False)
    return (yield)


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


@pytest.fixture(scope="module", autouse=True)
def worker_with_its_first_task(request: pytest.FixtureRequest) -> Iterator[None]:
    """A service in a test's own process has no compute worker until a task needs one: most never do.

    Each would take seconds of processor time to get warm. Modules marked ``warm_worker`` have it as a user does.
    """
    tier = request.path.relative_to(TESTS).parts[0]
    with pytest.MonkeyPatch.context() as patch:
        if tier in LAZY_WORKER and request.node.get_closest_marker("warm_worker") is None:
            patch.setattr("stereorig.server.worker.embedded.ComputeWorker.start", lambda _: None)
        yield


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service on the tiny rig, with an empty data folder of its own."""
    from stereorig.server.workflows.service import Service
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
