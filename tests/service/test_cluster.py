"""Analyses on a Dask cluster of processes: the same numbers as in the own worker, whatever becomes of a worker."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.copied_tests import write_test_folder
from tests.support.dask_bench import Cluster, Host, cluster_of
from tests.support.running_analyses import API, BODY, begin, contents, folder_of, wait_for_steps
from tests.support.service_rig import a_second, wait_for_job

STEPS = 7
INDEPENDENT = {"start_from": "reference"}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster_of(2, tmp_path_factory.mktemp("cluster")) as made:
        yield made


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_test_folder(folder / "tests" / "t000001-abcdef", STEPS, load_a_step=100.0)
    return folder


URL = f"{API}/tests/t000001-abcdef"


def measured(host: Host, **changes: Any) -> str:
    url, job = begin(host.client, URL, **changes)
    done = wait_for_job(host.client, job)
    assert done["state"] == "succeeded", done["problem"]
    return url


@pytest.fixture(scope="module")
def here(data: Path) -> dict[str, list[dict[str, Any]]]:
    """What the service's own worker finds, in a chain and with steps that need the reference alone."""
    host = Host(data, "")
    try:
        found = {}
        for name, changes in (("chain", {}), ("independent", INDEPENDENT)):
            folder = folder_of(host, measured(host, **changes))
            found[name] = [contents(folder / f"step_{n:04d}.nc") for n in range(STEPS)]
    finally:
        host.close()
    return found


@pytest.fixture(scope="module")
def elsewhere(data: Path, here: Any, cluster: Cluster) -> Iterator[Host]:
    """The same data folder, its analyses on the cluster, images by path."""
    host = Host(data, f'[compute]\nscheduler = "{cluster.address}"')
    yield host
    host.close()


def assert_equal(found: list[dict[str, Any]], folder: Path) -> None:
    for n, one in enumerate(found):
        two = contents(folder / f"step_{n:04d}.nc")
        assert one.keys() == two.keys()
        for name, values in one.items():
            if values.dtype.kind == "f":
                # single precision is the file's, not the measurement's
                limit = 1e-9 if values.dtype.itemsize == 8 else 1e-6
                np.testing.assert_allclose(two[name], values, rtol=limit, atol=limit * 1e-3, err_msg=f"{n} {name}")
            else:
                np.testing.assert_array_equal(two[name], values, err_msg=f"{n} {name}")
    assert np.nanmax(np.abs(found[-1]["w_mm"])) > 0.05  # a plate that bends


@pytest.mark.fault(44)
@pytest.mark.parametrize("kind", ["chain", "independent"])
def test_a_cluster_finds_what_the_worker_finds(elsewhere: Host, here: Any, kind: str) -> None:
    url = measured(elsewhere, **(INDEPENDENT if kind == "independent" else {}))
    assert_equal(here[kind], folder_of(elsewhere, url))
    assert elsewhere.client.get(url).json()["steps_finished"] == list(range(STEPS))


def test_a_killed_workers_steps_are_done_again(elsewhere: Host, here: Any, cluster: Cluster) -> None:
    url, job = begin(elsewhere.client, URL, **INDEPENDENT)
    wait_for_steps(elsewhere.client, url, 2)
    victim = cluster.workers.pop(0)
    os.kill(victim.pid, signal.SIGKILL)
    victim.wait()
    cluster.add_worker()
    done = wait_for_job(elsewhere.client, job)
    assert done["state"] == "succeeded", done["problem"]
    assert_equal(here["independent"], folder_of(elsewhere, url))


@pytest.mark.fault(43)
def test_an_analysis_on_the_cluster_is_cancelled_within_a_second_and_goes_on(elsewhere: Host, here: Any) -> None:
    client = elsewhere.client
    url, job = begin(client, URL, **INDEPENDENT)
    wait_for_steps(client, url, 2)
    limit = a_second(client)
    asked = time.monotonic()
    assert client.post(f"{API}/jobs/{job['id']}:cancel").status_code == 202
    assert wait_for_job(client, job)["state"] == "cancelled"
    assert time.monotonic() - asked < limit
    rest = client.post(f"{url}:continue").json()["job"]
    done = wait_for_job(client, rest)
    assert done["state"] == "succeeded", done["problem"]
    assert_equal(here["independent"], folder_of(elsewhere, url))


@pytest.mark.parametrize("kind", ["chain", "independent"])
def test_images_may_travel_with_the_steps(
    elsewhere: Host, data: Path, here: Any, cluster: Cluster, tmp_path: Path, kind: str
) -> None:
    shutil.copytree(data / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("a0*"))
    host = Host(tmp_path, f'[compute]\nscheduler = "{cluster.address}"\nimages = "scatter"')
    try:
        url = measured(host, **(INDEPENDENT if kind == "independent" else {}))
        assert_equal(here[kind], folder_of(host, url))
        names = {path.suffix for path in folder_of(host, url).iterdir()}
        assert ".npz" not in names  # nothing is left of what only an unfinished analysis needs
    finally:
        host.close()


def test_a_scheduler_that_is_not_there_is_named(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereorig.server.worker.dask_cluster._CONNECT_S", 0.5)
    shutil.copytree(data / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("a0*"))
    host = Host(tmp_path, '[compute]\nscheduler = "tcp://127.0.0.1:9"')
    try:
        _, job = begin(host.client, URL, **INDEPENDENT)
        problem = wait_for_job(host.client, job)["problem"]
        assert problem["code"] == "cluster_unreachable"
        assert "tcp://127.0.0.1:9" in problem["detail"]
    finally:
        host.close()


def reasons(host: Host) -> list[str]:
    return [one["code"] for one in host.client.get("/readyz").json().get("reasons", [])]


def test_readiness_says_that_the_scheduler_is_away_and_that_it_is_back(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stereorig.server.worker.dask_cluster._CONNECT_S", 0.5)
    monkeypatch.setattr("stereorig.server.worker.dask_cluster._LOOK_S", 0.0)
    shutil.copytree(data / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("a0*"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = listener.getsockname()
        host = Host(tmp_path, f'[compute]\nscheduler = "tcp://127.0.0.1:{address[1]}"')
        try:
            assert "scheduler_away" not in reasons(host)
            listener.close()
            assert "scheduler_away" in reasons(host)
            _, job = begin(host.client, URL, **INDEPENDENT)
            assert "Dask scheduler" in wait_for_job(host.client, job)["progress"]["phase"]
            with socket.create_server(address):
                assert "scheduler_away" not in reasons(host)
        finally:
            host.close()


def test_an_analysis_whose_scheduler_dies_says_that_it_waits_for_it(data: Path, tmp_path: Path) -> None:
    shutil.copytree(data / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("a0*"))
    with cluster_of(1, tmp_path) as cluster:
        host = Host(tmp_path, f'[compute]\nscheduler = "{cluster.address}"')
        try:
            _, job = begin(host.client, URL)
            while host.client.get(f"{API}/jobs/{job['id']}").json()["progress"]["phase"] == "waiting":
                time.sleep(0.05)
            assert "scheduler_away" not in reasons(host)
            cluster.scheduler.kill()
            cluster.scheduler.wait()
            seen = ""
            while "Dask scheduler" not in seen:
                document = host.client.get(f"{API}/jobs/{job['id']}").json()
                assert document["state"] == "running", document
                seen = document["progress"]["phase"]
                time.sleep(0.05)
            assert "scheduler_away" in reasons(host)
            assert client_cancels(host, job)["state"] == "cancelled"
        finally:
            host.close()


def client_cancels(host: Host, job: dict[str, Any]) -> dict[str, Any]:
    assert host.client.post(f"{API}/jobs/{job['id']}:cancel").status_code == 202
    return wait_for_job(host.client, job)


def test_steps_that_start_from_the_reference_need_total_correlation(elsewhere: Host) -> None:
    body = {**BODY, **INDEPENDENT, "reference_update": "always"}
    answer = elsewhere.client.post(f"{URL}/analyses", json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, "values_disagree")
