"""A test in one file: opened elsewhere it is the same test; what is cut, altered or hostile leaves nothing behind."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stereorig.core.errors import StereorigError
from stereorig.server.cell.cell import Cell
from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats import disk
from stereorig.server.store.bundle.pack import pack
from stereorig.server.store.bundle.unpack import OpenedTest
from stereorig.server.store.bundle.unpack import unpack as unpack_in
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.faulty_disk import WAYS, FaultyDisk, Way
from tests.support.measured_test import API, measured_test
from tests.support.service_rig import SMALL, served

MANIFEST = "stereorig-bundle.json"


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A data folder, a test and its analysis."""
    data = tmp_path_factory.mktemp("bundle") / "data"
    return data, *measured_test(data)


@pytest.fixture(scope="module")
def bundle(measured: tuple[Path, str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its bundle."""
    path = tmp_path_factory.mktemp("packed") / "test.zip"
    pack(measured[0], measured[1], path, licence="https://creativecommons.org/licenses/by/4.0/")
    return path


CELL = Cell()


@pytest.fixture(scope="module", autouse=True)
def one_cell() -> Iterator[None]:
    """For all bundles: each alone would load the readers anew."""
    yield
    CELL.close()


def unpack(bundle: Path, data: Path) -> OpenedTest:
    return unpack_in(bundle, data, cell=CELL)


def everything(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def members(bundle: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(bundle) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_opened_elsewhere_it_is_the_same_test_and_measures_the_same_bits(
    measured: tuple[Path, str, str], bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, test_id, analysis_id = measured
    there = tmp_path / "elsewhere" / "data"
    assert main(["bundle", "--open", str(bundle), "--data", str(there)]) == 0
    own = everything(data / "tests" / test_id)
    assert everything(there / "tests" / test_id) == own
    assert main(["verify", str(there)]) == 0
    assert verify(there).findings == ()
    capsys.readouterr()
    assert main(["reproduce", f"{test_id}/{analysis_id}", "--data", str(there), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["repetitions"][0]["verdict"] == "equal"
    service = Service(parse_config(SMALL), there).start()
    try:
        with served(service) as client:
            assert [test["id"] for test in client.get(f"{API}/tests").json()["tests"]] == [test_id]
            shown = client.get(f"{API}/tests/{test_id}/analyses/{analysis_id}").json()
            assert (shown["state"], shown["steps_finished"], shown["stale"]) == ("succeeded", [0, 1, 2], False)
    finally:
        service.close()


def test_it_unzips_into_a_data_folder_by_hand(bundle: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(tmp_path / "data", [name for name in archive.namelist() if name.startswith("tests/")])
    assert verify(tmp_path / "data").sound


def test_repositories_can_show_it(measured: tuple[Path, str, str], bundle: Path) -> None:
    """What RO-Crate 1.1 demands of the metadata: descriptor, root with a date, every file a part, no loose end."""
    _, test_id, analysis_id = measured
    held = members(bundle)
    found = json.loads(held["ro-crate-metadata.json"])
    assert found["@context"][0] == "https://w3id.org/ro/crate/1.1/context"
    graph = {entity["@id"]: entity for entity in found["@graph"]}
    assert len(graph) == len(found["@graph"])
    assert graph["ro-crate-metadata.json"]["about"] == {"@id": "./"}
    assert graph["ro-crate-metadata.json"]["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    root = graph["./"]
    assert root["@type"] == "Dataset"
    assert {"name", "description", "datePublished", "license"} <= set(root)
    assert {part["@id"] for part in root["hasPart"]} == set(held) - {"ro-crate-metadata.json"}
    for name in set(held) - {"ro-crate-metadata.json", MANIFEST}:
        assert (graph[name]["@type"], graph[name]["contentSize"]) == ("File", str(len(held[name])))
    action = graph[f"#{analysis_id}"]
    assert action["@type"] == "CreateAction"
    assert {one["@id"] for one in action["result"]} == {
        f"tests/{test_id}/analyses/{analysis_id}/step_{n:04d}.nc" for n in range(3)
    }
    linked = [one["@id"] for one in (*action["object"], *action["result"], action["instrument"], *root["mentions"])]
    assert [one for one in linked if one not in graph] == []


def test_a_test_that_is_there_is_not_replaced(
    measured: tuple[Path, str, str], bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    shutil.copytree(measured[0], data)
    before = everything(data / "tests")
    assert main(["bundle", "--open", str(bundle), "--data", str(data)]) == 1
    assert capsys.readouterr().err.startswith("stereorig: test_exists: ")
    assert everything(data / "tests") == before
    folder = DataFolder(data).open()
    try:
        assert main(["bundle", "--open", str(bundle), "--data", str(data)]) == 1
        assert capsys.readouterr().err.startswith("stereorig: data_folder_locked: ")
    finally:
        folder.close()


def rewritten(bundle: Path, out: Path, change: Callable[[dict[str, bytes]], Any]) -> Path:
    """Return the bundle with other members."""
    held = members(bundle)
    more = change(held) or []
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in (*held.items(), *more):
            archive.writestr(name, content)
    return out


def listed(held: dict[str, bytes], name: str, content: bytes) -> None:
    """Put a file into a bundle, and into its manifest."""
    import hashlib

    manifest = json.loads(held[MANIFEST])
    manifest["files"][name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    held[name], held[MANIFEST] = content, json.dumps(manifest).encode()


def name_of(held: dict[str, bytes], end: str) -> str:
    return next(name for name in held if name.endswith(end))


def _flip(held: dict[str, bytes]) -> None:
    name = name_of(held, "0001/cam1.tif")
    content = bytearray(held[name])
    content[len(content) // 2] ^= 1
    held[name] = bytes(content)


def _flip_with_manifest(held: dict[str, bytes]) -> None:
    _flip(held)
    name = name_of(held, "0001/cam1.tif")
    listed(held, name, held[name])


def _drop(held: dict[str, bytes]) -> None:
    del held[name_of(held, "0002/cam2.tif")]


def _add(held: dict[str, bytes]) -> None:
    held[name_of(held, "test.json").replace("test.json", "workspace.json")] = b"{}"


def _climb(held: dict[str, bytes]) -> None:
    listed(held, "tests/../../evil.txt", b"evil")


def _absolute(held: dict[str, bytes]) -> None:
    listed(held, "/tmp/evil.txt", b"evil")


def _climb_inside(held: dict[str, bytes]) -> None:
    listed(held, name_of(held, "test.json").replace("test.json", "steps/../../../evil.json"), b"{}")


def _other_name(held: dict[str, bytes]) -> None:
    listed(held, name_of(held, "test.json").replace("test.json", "run.sh"), b"#!/bin/sh")


def _newer(held: dict[str, bytes]) -> None:
    held[MANIFEST] = json.dumps({**json.loads(held[MANIFEST]), "format": 2}).encode()


def _no_manifest(held: dict[str, bytes]) -> None:
    del held[MANIFEST]


def _no_json(held: dict[str, bytes]) -> None:
    held[MANIFEST] = b"[" * 100_000


def _deep(held: dict[str, bytes]) -> None:
    listed(held, name_of(held, "test.json"), b'{"a":' * 100_000 + b"1" + b"}" * 100_000)


def _another_id(held: dict[str, bytes]) -> None:
    name = name_of(held, "test.json")
    listed(held, name, json.dumps({**json.loads(held[name]), "id": "t000007-abcdef"}).encode())


def _no_steps(held: dict[str, bytes]) -> None:
    listed(held, name_of(held, "/summary.json"), b"{}")


def _other_digits(held: dict[str, bytes]) -> None:
    """The test's id in digits that Unicode knows, and no id of ours has."""
    manifest = json.loads(held.pop(MANIFEST))
    old = manifest["test_id"]
    new = old[0] + "".join(chr(0x0660 + int(digit)) for digit in old[1:7]) + old[7:]
    for name in list(manifest["files"]):
        moved = name.replace(old, new)
        held[moved] = (
            held.pop(name).replace(old.encode(), new.encode()) if name.endswith("test.json") else held.pop(name)
        )
        del manifest["files"][name]
        manifest["files"][moved] = {"bytes": len(held[moved]), "sha256": hashlib.sha256(held[moved]).hexdigest()}
    held[MANIFEST] = json.dumps({**manifest, "test_id": new}, ensure_ascii=False).encode()


def _no_sums(held: dict[str, bytes]) -> None:
    held[MANIFEST] = json.dumps({**json.loads(held[MANIFEST]), "files": [1]}).encode()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def _twice(held: dict[str, bytes]) -> list[tuple[str, bytes]]:
    return [(name_of(held, "test.json"), b"{}")]


ALTERED = {
    _flip: "bundle_altered",
    _flip_with_manifest: "bundle_altered",
    _drop: "bundle_altered",
    _add: "bundle_altered",
    _climb: "bundle_refused",
    _absolute: "bundle_refused",
    _climb_inside: "bundle_refused",
    _other_name: "bundle_refused",
    _newer: "bundle_newer",
    _no_manifest: "bundle_unreadable",
    _no_json: "bundle_altered",
    _deep: "bundle_altered",
    _another_id: "bundle_altered",
    _no_sums: "bundle_altered",
    _no_steps: "bundle_altered",
    _other_digits: "bundle_altered",
    _twice: "bundle_refused",
}


def refused_with(bundle: Path, tmp_path: Path) -> str:
    """Open it in a folder that is not there yet; return the error's code once nothing is found to be left behind."""
    home = tmp_path / "home"
    home.mkdir()
    with pytest.raises(StereorigError) as caught:
        unpack(bundle, home / "data")
    assert list(home.iterdir()) == []
    assert caught.value.remedy
    return caught.value.code


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
@pytest.mark.parametrize("change", ALTERED, ids=lambda change: change.__name__)
def test_what_is_altered_or_hostile_is_refused_and_leaves_nothing(
    bundle: Path, tmp_path: Path, change: Callable[[dict[str, bytes]], Any]
) -> None:
    code = refused_with(rewritten(bundle, tmp_path / "bad.zip", change), tmp_path)
    assert code == ALTERED[change]
    assert not (tmp_path / "evil.txt").exists()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.9999])
def test_a_bundle_that_was_cut_short_is_refused(bundle: Path, tmp_path: Path, share: float) -> None:
    content = bundle.read_bytes()
    (tmp_path / "cut.zip").write_bytes(content[: int(share * len(content))])
    assert refused_with(tmp_path / "cut.zip", tmp_path) == "bundle_unreadable"


def test_flipped_bytes_anywhere_never_open_another_test(
    measured: tuple[Path, str, str], bundle: Path, tmp_path: Path
) -> None:
    """Whatever byte of the archive is another one: refused with nothing left, or the very same test."""
    content = bundle.read_bytes()
    own = everything(measured[0] / "tests")
    tail = len(content) - 22 - 64 * 60  # the directory and the end of the archive, besides places in the middle
    places = [*range(0, tail, max(1, tail // 25)), *range(max(tail, 0), len(content), 211)]
    for k, place in enumerate(places):
        spoiled = bytearray(content)
        spoiled[place] ^= 0xFF
        (tmp_path / "spoiled.zip").write_bytes(bytes(spoiled))
        data = tmp_path / f"data{k}"
        try:
            unpack(tmp_path / "spoiled.zip", data)
        except StereorigError:
            assert not data.exists(), place
        else:
            assert everything(data / "tests") == own, place
            shutil.rmtree(data)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(bundle: Path, tmp_path: Path) -> None:
    held = members(bundle)
    name = name_of(held, "test.json").replace("test.json", "workspace.json")
    listed(held, name, b" " * (64 << 20))
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in held.items():
            archive.writestr(member, content)
    assert (tmp_path / "bomb.zip").stat().st_size < 8 << 20
    assert refused_with(tmp_path / "bomb.zip", tmp_path) == "bundle_refused"


def test_members_that_overlap_are_refused(bundle: Path, tmp_path: Path) -> None:
    """A directory whose entries all point at the same bytes: small on disk, and without end once unpacked."""
    content = bytearray(bundle.read_bytes())
    at = content.rfind(b"PK\x05\x06")
    start = struct.unpack_from("<I", content, at + 16)[0]
    for place in _entries(content, start, at):
        struct.pack_into("<I", content, place + 20, len(content) // 2)
    (tmp_path / "overlap.zip").write_bytes(bytes(content))
    assert refused_with(tmp_path / "overlap.zip", tmp_path) == "bundle_refused"


def _entries(content: bytearray, start: int, end: int) -> Iterator[int]:
    place = start
    while place < end and content[place : place + 4] == b"PK\x01\x02":
        yield place
        name, extra, comment = struct.unpack_from("<HHH", content, place + 28)
        place += 46 + name + extra + comment


@pytest.mark.parametrize("way", WAYS)
def test_a_disk_that_fails_leaves_nothing_half_opened(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: Way
) -> None:
    """At whatever call the disk fails, all of the test is there, or none."""
    data = tmp_path / "data"
    DataFolder(data).open().close()
    test = members(bundle)
    for n in (1, 2, 5, 9, 14, 20, 30):
        faulty = FaultyDisk(way, n)
        with monkeypatch.context() as patch:
            patch.setattr(disk, "disk", faulty)
            try:
                unpack(bundle, data)
            except StereorigError as error:
                assert error.code in ("storage_full", "storage_failed", "data_folder_unusable"), error  # noqa: PT017
        assert list(data.glob(".*.part")) == []
        there = everything(data / "tests")
        assert there in ({}, {k.removeprefix("tests/"): v for k, v in test.items() if k.startswith("tests/")})
        shutil.rmtree(data / "tests")
        (data / "tests").mkdir()


def test_a_kill_while_it_is_opened_leaves_a_folder_that_the_next_start_removes(tmp_path: Path) -> None:
    data = tmp_path / "data"
    DataFolder(data).open().close()
    left = data / ".opening-0011aabb.part" / "tests" / "t000001-abcdef" / "steps"
    left.mkdir(parents=True)
    (left / "cam1.tif").write_bytes(b"half")
    assert {finding.level for finding in verify(data).findings} <= {"incomplete", "index"}
    DataFolder(data).open().close()
    assert not (data / ".opening-0011aabb.part").exists()


def test_a_damaged_test_is_not_packed(
    measured: tuple[Path, str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    shutil.copytree(measured[0], data)
    image = next(data.glob("tests/*/steps/0001/cam1.tif"))
    image.write_bytes(image.read_bytes()[:-9])
    out = tmp_path / "out.zip"
    assert main(["bundle", measured[1], "--data", str(data), "-o", str(out)]) == 1
    assert capsys.readouterr().err.startswith("stereorig: test_damaged: ")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_nothing_is_overwritten_and_links_stay_outside(
    measured: tuple[Path, str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.zip"
    out.write_bytes(b"mine")
    assert main(["bundle", measured[1], "--data", str(measured[0]), "-o", str(out)]) == 1
    assert out.read_bytes() == b"mine"
    assert main(["bundle", "--data", str(measured[0])]) == 1
    assert "invalid_input" in capsys.readouterr().err
    data = tmp_path / "data"
    shutil.copytree(measured[0], data)
    (tmp_path / "secret.json").write_text("{}")
    (data / "tests" / measured[1] / "workspace.json").symlink_to(tmp_path / "secret.json")
    pack(data, measured[1], tmp_path / "linked.zip")
    assert not any(name.endswith("workspace.json") for name in members(tmp_path / "linked.zip"))


@pytest.mark.fault(55)
@pytest.mark.parametrize("kind", ["external storage", "virtual data set"])
def test_a_result_whose_data_lie_elsewhere_is_refused(bundle: Path, tmp_path: Path, kind: str) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(200)))
    held = members(bundle)
    name = next(name for name in held if name.endswith("step_0001.nc"))
    (tmp_path / "r.nc").write_bytes(held[name])
    with h5py.File(tmp_path / "r.nc", "a") as file, h5py.File(tmp_path / "other.h5", "w") as other:
        other["w"] = np.arange(10.0)
        if kind == "external storage":
            file.create_dataset("secret", (10,), np.uint8, external=[(str(secret), 0, 10)])
        else:
            layout = h5py.VirtualLayout((10,), np.float64)
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "w", (10,))
            file.create_virtual_dataset("secret", layout)
    held[name] = (tmp_path / "r.nc").read_bytes()
    held[f"{name}.sha256"] = f"{hashlib.sha256(held[name]).hexdigest()}  step_0001.nc\n".encode()
    manifest = json.loads(held[MANIFEST])
    for one in (name, f"{name}.sha256"):
        manifest["files"][one] = {"bytes": len(held[one]), "sha256": hashlib.sha256(held[one]).hexdigest()}
    held[MANIFEST] = json.dumps(manifest).encode()
    hostile, there = tmp_path / "hostile.zip", tmp_path / "data"
    with zipfile.ZipFile(hostile, "w") as archive:
        for one, content in held.items():
            archive.writestr(one, content)
    with pytest.raises(StereorigError) as caught:
        unpack(hostile, there)
    assert caught.value.code == "file_refers_elsewhere"
    assert not there.exists()
