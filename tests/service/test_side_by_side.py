"""A long test in its default settings, measured in blocks side by side: the results of one step after another."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.field.sequence.joint import AGREE_SIGMAS
from stereorig.server.workflows.analysis.blocks import Blocks
from tests.support import sequence_bench as bench
from tests.support.copied_tests import write_test_of
from tests.support.dask_bench import Host, cluster_of
from tests.support.running_analyses import API, begin, contents, folder_of, wait_for_steps
from tests.support.service_rig import wait_for_job

STEPS = 15
URL = f"{API}/tests/t000001-abcdef"
BODY = {"region": {"rectangle": [170, 160, 350, 320]}, "subset_px": 33, "spacing_px": 14}
POOL = "[compute]\nprocesses = 2"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate that turns by 7 degrees, moves by 16 px and stretches, while its pattern goes over to another one."""
    folder = tmp_path_factory.mktemp("data")
    scenes = [
        bench.plate(0.5 * n, np.array([0.04, -0.02, 0.02]) * n, np.diag([1 + 0.002 * n, 1 - 0.001 * n]))
        for n in range(STEPS)
    ]
    images = (bench.capture_fading(scene, 3.6 * n, n) for n, scene in enumerate(scenes))
    write_test_of(folder / "tests" / "t000001-abcdef", bench.rig().pair, images)
    return folder


def results(host: Host, url: str) -> list[dict[str, Any]]:
    return [contents(folder_of(host, url) / f"step_{n:04d}.nc") for n in range(STEPS)]


def measured(host: Host, **changes: Any) -> str:
    url, job = begin(host.client, URL, **{**BODY, **changes})
    done = wait_for_job(host.client, job, seconds=900.0)
    assert done["state"] == "succeeded", done["problem"]
    assert host.client.get(url).json()["steps_finished"] == list(range(STEPS))
    return url


@pytest.fixture(scope="module")
def host(data: Path) -> Iterator[Host]:
    """A service with two processes of its own for analyses."""
    made = Host(data, POOL)
    yield made
    made.close()


@pytest.fixture(scope="module")
def chain(host: Host) -> list[dict[str, Any]]:
    """What one step after another gives."""
    return results(host, measured(host, side_by_side="never"))


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the plans ask for."""
    kinds: list[str] = []
    ask = Blocks.ask

    def noted(plan: Blocks) -> Any:
        found = ask(plan)
        kinds.extend([] if found is None else [found.kind])
        return found

    monkeypatch.setattr(Blocks, "ask", noted)
    return kinds


def assert_as_chain(found: list[dict[str, Any]], chain: list[dict[str, Any]]) -> None:
    for n, (one, two) in enumerate(zip(chain, found, strict=True)):
        assert one.keys() == two.keys()
        np.testing.assert_array_equal(two["status"], one["status"], err_msg=str(n))
        if "reference_step" in one:  # not in a step that was matched against the first one
            np.testing.assert_array_equal(two["reference_step"], one["reference_step"], err_msg=str(n))
        if n == 0:
            continue
        for name in "uvw":
            off = (two[f"{name}_mm"] - one[f"{name}_mm"]) / one[f"sigma_{name}_mm"]
            assert np.sqrt(np.nanmean(off**2)) < AGREE_SIGMAS, (n, name)
            # a fit ends where its next step is small: which processor rounds how decides whether it takes that step
            assert np.nanmax(np.abs(off)) < 5.0 * AGREE_SIGMAS, (n, name)
        assert np.nanmedian(two["sigma_u_mm"] / one["sigma_u_mm"]) == pytest.approx(1.0, abs=1e-3)


def references_of(found: list[dict[str, Any]]) -> list[int]:
    return [int(np.median(one["reference_step"])) if "reference_step" in one else 0 for one in found]


def test_a_reference_is_left_once_in_the_sequence(chain: list[dict[str, Any]]) -> None:
    assert len(set(references_of(chain))) == 2
    assert np.nanmax(np.hypot(chain[-1]["u_mm"], chain[-1]["v_mm"])) > 14 * 0.039  # px, mm a pixel
    assert all((one["status"] == 0).mean() > 0.95 for one in chain)


def test_processes_of_one_machine_find_what_one_after_another_finds(
    host: Host, chain: list[dict[str, Any]], asked: list[str]
) -> None:
    url = measured(host)
    assert_as_chain(results(host, url), chain)
    assert {"head", "joint"} <= set(asked)
    left = {path.name for path in folder_of(host, url).iterdir() if path.name.startswith(("head", "starts"))}
    assert left == set()


@pytest.mark.deep
@pytest.mark.parametrize("images", ["path", "scatter"])
def test_a_cluster_finds_what_one_after_another_finds(
    data: Path, chain: list[dict[str, Any]], asked: list[str], tmp_path: Path, images: str
) -> None:
    shutil.copytree(data / "tests", tmp_path / "data" / "tests", ignore=shutil.ignore_patterns("a0*"))
    with cluster_of(2, tmp_path) as cluster:
        cluster.await_workers(2)
        host = Host(tmp_path / "data", f'[compute]\nscheduler = "{cluster.address}"\nimages = "{images}"')
        try:
            assert_as_chain(results(host, measured(host)), chain)
            assert {"head", "joint"} <= set(asked)
        finally:
            host.close()


@pytest.mark.deep
def test_what_was_cancelled_goes_on_where_it_was_and_comes_to_the_same(
    host: Host, chain: list[dict[str, Any]], asked: list[str]
) -> None:
    url, job = begin(host.client, URL, **BODY)
    wait_for_steps(host.client, url, 4)
    assert host.client.post(f"{API}/jobs/{job['id']}:cancel").status_code == 202
    assert wait_for_job(host.client, job)["state"] == "cancelled"
    there = {path.name for path in folder_of(host, url).glob("step_*.nc")}
    before = len(asked)
    rest = host.client.post(f"{url}:continue").json()["job"]
    done = wait_for_job(host.client, rest, seconds=900.0)
    assert done["state"] == "succeeded", done["problem"]
    assert_as_chain(results(host, url), chain)
    again = [kind for kind in asked[before:] if kind != "head"]
    assert len(again) <= STEPS - len(there) + 4  # a joint and what it throws away, no more


@pytest.mark.parametrize("changes", [{"reference_update": "always"}])
def test_one_after_another_is_what_the_settings_can_ask_for(
    host: Host, asked: list[str], changes: dict[str, str]
) -> None:
    url, job = begin(host.client, URL, **{**BODY, **changes}, steps=list(range(1, 9)))
    done = wait_for_job(host.client, job, seconds=900.0)
    assert done["state"] == "succeeded", done["problem"]
    assert asked == []
    assert host.client.get(url).json()["steps_finished"] == list(range(9))
