"""The data folder moved away, replaced and put back under a running service; no answer names a path of the server."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from stereorig.core.errors import StorageError
from stereorig.server.base.problem import problem_of, without_paths
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.problems import assert_problem
from tests.support.service_rig import new_test, served, tiny_config, wait_for_rig

API = "/api/v1"
pytestmark = pytest.mark.warm_worker


@pytest.fixture
def host(tmp_path: Path) -> Iterator[tuple[Service, httpx.Client]]:
    service = Service(tiny_config(), tmp_path / "the data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            yield service, client
    finally:
        service.close()


def reasons(client: httpx.Client) -> list[str]:
    answer = client.get("/readyz").json()
    return [one["code"] for one in answer.get("reasons", []) if one["code"] != "worker_starting"]


@pytest.mark.fault(3)
@pytest.mark.parametrize("replaced", [False, True])
def test_a_folder_that_is_gone_is_named_by_every_request_and_found_again(
    host: tuple[Service, httpx.Client], replaced: bool
) -> None:
    service, client = host
    test_id = new_test(client)
    assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201
    assert reasons(client) == []
    away = service.folder.root.with_name("away")
    service.folder.root.rename(away)
    if replaced:
        service.folder.root.mkdir()
    try:
        assert client.get("/readyz").status_code == 503
        assert reasons(client) == ["data_folder_gone"]
        asked = [
            client.post(f"{API}/tests/{test_id}/steps", json={}),
            client.post(f"{API}/tests", json={"name": "x"}),
            client.get(f"{API}/tests/{test_id}/steps/0/cam1"),
            client.post(f"{API}/calibrations", json={}),
            client.post(f"{API}/noise", json={}),
            client.put(f"{API}/tests/{test_id}/metadata", json={"material": "steel"}),
            client.post(f"{API}/tests/{test_id}/steps:import", files={"cam1": b"x", "cam2": b"x"}),
        ]
        for answer in asked[:-1]:
            assert_problem(answer, 507, "data_folder_gone")
        assert not [answer.text for answer in asked if str(service.folder.root.parent) in answer.text]
        assert client.post(f"{API}/stage:stop").status_code == 200
    finally:
        if replaced:
            for left in sorted(service.folder.root.rglob("*"), reverse=True):
                left.rmdir() if left.is_dir() else left.unlink()
            service.folder.root.rmdir()
        away.rename(service.folder.root)
    assert reasons(client) == []
    assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201


@pytest.mark.fault(3)
def test_a_disk_that_became_read_only_is_named_and_what_is_there_is_read(
    host: tuple[Service, httpx.Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, client = host
    test_id = new_test(client)
    with monkeypatch.context() as patch:
        patch.setattr("stereorig.server.store.folder.os.statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
        assert reasons(client) == ["data_folder_read_only"]
        assert_problem(client.post(f"{API}/tests/{test_id}/steps", json={}), 507, "data_folder_read_only")
        assert client.get(f"{API}/tests/{test_id}").status_code == 200
        assert_problem(client.get(f"{API}/tests/t000099-abcdef"), 404, "not_found")
    assert reasons(client) == []


def test_a_disk_without_a_byte_is_full_though_nothing_is_kept_free(
    host: tuple[Service, httpx.Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = host[0].folder
    folder.require_room(0.0)
    monkeypatch.setattr(folder, "free_mib", lambda: 0.0)
    with pytest.raises(StorageError) as caught:
        folder.require_room(0.0)
    assert caught.value.code == "storage_full"


def test_texts_of_problems_name_files_of_the_data_folder_from_there_and_others_by_their_name(
    host: tuple[Service, httpx.Client],
) -> None:
    root = host[0].folder.root
    for text, expected in (
        (f"Writing {root}/tests/t1/step.json failed.", "Writing tests/t1/step.json failed."),
        (f"{root} is full.", "the data folder is full."),
        ("'/home/a b/x.tif' and (/etc/keys.json), /tmp/x/.", "'a b/x.tif' and (keys.json), x."),
        (
            "GET /rig, /api/v1/tests/x and 3 mm/s of /dev/ttyUSB0",
            "GET /rig, /api/v1/tests/x and 3 mm/s of /dev/ttyUSB0",
        ),
    ):
        assert without_paths(text) == expected
    problem = problem_of(FileNotFoundError(2, "No such file or directory", f"{root}/x/y"))
    assert str(root) not in str(problem.plain())


@pytest.mark.fault(46)
def test_no_answer_to_what_fails_names_a_path_of_the_server(
    host: tuple[Service, httpx.Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, client = host
    test_id = new_test(client)
    client.post(f"{API}/tests/{test_id}/steps", json={}).raise_for_status()
    test = service.folder.root / "tests" / test_id
    (test / "steps" / "0000" / "cam1.tif").write_bytes(b"no image")
    (service.folder.root / "recipes").mkdir(exist_ok=True)
    (service.folder.root / "recipes" / "x.json").write_text("{")
    xdmf = b'<?xml version="1.0"?><Xdmf><Domain><Grid><Topology TopologyType="Triangle"><DataItem Format="HDF">x.h5:/a'
    asked: list[httpx.Response] = [
        client.get(f"{API}/tests/{test_id}/steps/0/cam1"),
        client.get(f"{API}/tests/{test_id}/steps/0/cam1?format=png"),
        client.post(f"{API}/tests/{test_id}/models", files={"file": ("m.xdmf", xdmf), "heavy": ("x.h5", b"no HDF5")}),
        client.post(f"{API}/tests/{test_id}/models", files={"file": ("m.vtu", b"<VTKFile/>")}),
        client.post(f"{API}/calibrations:import", files={"file": ("c.yml", b"%YAML:1.0\n---\nx: !!opencv-matrix")}),
        client.post(f"{API}/calibrations:import", files={"file": ("c.json", b"{}")}),
        client.post(f"{API}/tests:open", files={"file": ("b.zip", b"PK no archive")}),
        client.post(f"{API}/tests/{test_id}/channels:import", files={"file": ("c.csv", b"a,b\n1,2")}),
        client.post(f"{API}/tests/{test_id}/analyses", json={}),
        client.get(f"{API}/tests/{test_id}/export?format=csv"),
        client.get(f"{API}/recipes"),
        client.get(f"{API}/recipes/x"),
        client.delete(f"{API}/tests/{test_id}/steps/7"),
    ]
    with monkeypatch.context() as patch:

        def fails(*_: object) -> None:
            raise OSError(5, "Input/output error", str(test / "steps"))

        patch.setattr("stereorig.server.formats.disk.Disk.sync", fails)
        asked.append(client.post(f"{API}/tests", json={"name": "x"}))
        assert_problem(asked[-1], 507, "storage_failed")
        made = client.post(f"{API}/noise", json={"frames": 4})
        asked.append(made)
        deadline = Deadline(60.0)
        while made.status_code == 202 and deadline.left:
            asked.append(client.get(f"{API}/jobs/{made.json()['job']['id']}"))
            if asked[-1].json()["state"] not in ("queued", "running"):
                break
    assert sum(answer.status_code >= 400 for answer in asked) >= 10
    assert not [answer.text for answer in asked if str(service.folder.root) in answer.text]
    assert not [answer.text for answer in asked if str(service.folder.root.parent) in answer.text]
