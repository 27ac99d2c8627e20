"""Every file of a data folder changed, emptied, deleted or swapped: `verify` names it, and so does the request."""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.store.repair import repair
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, new_test, plate_test, served, wait_for_job

API = "/api/v1"
BODY = {"region": {"rectangle": [80, 80, 160, 150]}, "subset_px": 21, "spacing_px": 10, "strain": None}
MODEL = b"x,y,z,ux,uy,uz\n" + b"".join(b"%d,%d,0,0,0,0.01\n" % (x, y) for x in (-20, 0, 20) for y in (-20, 0, 20))
#: what a checker may do to a file; the last takes the place of a file by another one of its kind
ATTACKS = ("flip", "empty", "delete", "swap")
#: requests that read a file, by its name in the data folder; files of other names are read by jobs alone
READERS = (
    (r"tests/(T)/test\.json", "/tests/{0}"),
    (r"tests/(T)/manifest\.json", "/tests/{0}"),
    (r"tests/(T)/workspace\.json", "/tests/{0}/workspace"),
    (r"tests/(T)/calibration\.json", "/tests/{0}/analyses/{analysis}/steps/1/positions/cam2"),
    (r"tests/(T)/steps/(\d+)/step\.json", "/tests/{0}/steps/{1}"),
    (r"tests/(T)/steps/(\d+)/(cam[12])\.tif", "/tests/{0}/steps/{1}/{2}"),
    (r"tests/(T)/analyses/(A)/(?:analysis|summary)\.json", "/tests/{0}/analyses/{1}"),
    (r"tests/(T)/analyses/(A)/step_(\d+)\.nc(?:\.sha256)?", "/tests/{0}/analyses/{1}/steps/{2}/fields/z_mm"),
    (r"tests/(T)/models/(M)/model\.json", "/tests/{0}/models"),
    (r"calibrations/(C)/(?:plan|review|manifest)\.json", "/calibrations/{0}"),
    (r"calibrations/(C)/calibration\.json(?:\.sha256)?", "/calibrations/{0}/file"),
    (r"noise/(N)/(?:plan|manifest|noise)\.json(?:\.sha256)?", "/noise/{0}"),
    (r"recipes/(R)\.json", "/recipes/{0}"),
)
_ID = r"[a-z]\d{6}-[0-9a-f]{6}"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a bit of everything, its service ended."""
    data = tmp_path_factory.mktemp("manifest") / "data"
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            test = f"{API}/tests/{plate_test(client)}"
            for _ in range(2):
                client.post(f"{test}/steps", json={}).raise_for_status()
            done = wait_for_job(client, client.post(f"{test}/analyses", json=BODY).json()["job"])
            assert done["state"] == "succeeded", done["problem"]
            client.post(f"{test}/models", files={"file": ("m.csv", MODEL)}, data={"unit": "mm"}).raise_for_status()
            put = {"headers": {"If-Match": "*"}}
            client.put(f"{test}/workspace", json={"image_size_px": [256, 240]}, **put).raise_for_status()
            client.post(f"{API}/recipes", json={"name": "coupon", "recipe": {"version": 1}}).raise_for_status()
            done = wait_for_job(client, client.post(f"{API}/noise", json={"frames": 2}).json()["job"])
            assert done["state"] == "succeeded", done["problem"]
    finally:
        service.close()
    return data


@pytest.fixture
def data(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "data"))


@pytest.fixture(scope="module")
def attacked(written: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, httpx.Client]]:
    """A service whose data folder is damaged under it, file by file, and mended each time."""
    data = Path(shutil.copytree(written, tmp_path_factory.mktemp("attacked") / "data"))
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client, pytest.MonkeyPatch.context() as patch:
            patch.setattr("stereorig.server.store.verify._WRITING_S", 0.01)  # nothing is written meanwhile
            yield data, client
    finally:
        service.close()


def files_of(data: Path) -> list[Path]:
    """Return every file of data: all but the catalogue, what a service keeps for itself, and what is of no effect."""
    ours = re.compile(r"catalog\.|service\.lock|audit\.log|format\.json|\.exports")
    names = sorted(path.relative_to(data) for path in data.rglob("*") if path.is_file())
    return [name for name in names if not ours.match(name.parts[0]) and "starts_" not in name.name]


def spoil(path: Path, attack: str, others: list[Path], rng: random.Random) -> bool:
    """Damage a file as a failing disk would, its times and size as they were where that is possible."""
    content, stat = path.read_bytes(), path.stat()
    if attack == "delete":
        path.unlink()
        return True
    same = [one.read_bytes() for one in others if one.suffix == path.suffix and one != path]
    different = [one for one in same if one != content]
    if attack == "swap" and not different:
        return False
    changed = bytearray(content)
    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    path.write_bytes({"flip": bytes(changed), "empty": b"", "swap": rng.choice(different or [b""])}[attack])
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return True


def request_for(name: str, analysis: str) -> str | None:
    """Return the request that reads a file."""
    for pattern, url in READERS:
        found = re.fullmatch(re.sub(r"\((T|A|M|C|N|R)\)", lambda _: f"({_ID})", pattern), name)
        if found is not None:
            return API + url.format(*found.groups(), analysis=analysis)
    return None


def check_attacks(data: Path, client: httpx.Client, attacks: tuple[str, ...], rng: random.Random) -> int:
    """Damage each file in each way, ask, and mend it; return the number of attacks."""
    analysis = next(data.glob("tests/*/analyses/*")).name
    names, made = files_of(data), 0
    for name in names:
        path, url = data / name, request_for(name.as_posix(), analysis)
        whole, stat = path.read_bytes(), path.stat()
        before = None if url is None else client.get(url)
        assert before is None or before.status_code == 200, (url, before.text)
        for attack in attacks:
            if not spoil(path, attack, [data / one for one in names], rng):
                continue
            made += 1
            answer = None if url is None else client.get(url)
            listed = client.get(f"{API}/tests")
            damaged = {finding.path for finding in verify(data).findings if finding.level == "damaged"}
            path.write_bytes(whole)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            assert name.as_posix() in damaged, (attack, name, damaged)
            assert listed.status_code == 200, (attack, name)
            if answer is not None:
                assert answer.status_code == 409, (attack, name, url, answer.status_code)
                assert answer.json()["code"] in ("checksum_mismatch", "file_missing"), answer.text
                assert str(data) not in answer.text
        assert before is None or client.get(str(url)).content == before.content, (url, "after it was mended")
    assert verify(data).sound
    return made


@pytest.mark.fault(57)
@pytest.mark.fault(4)
def test_each_file_that_is_damaged_is_named_by_verify_and_by_the_request_that_reads_it(
    attacked: tuple[Path, httpx.Client],
) -> None:
    assert check_attacks(*attacked, ATTACKS, random.Random(1)) > 60


@pytest.mark.deep
@pytest.mark.fault(57)
def test_a_thousand_flips_swaps_and_losses_are_all_named(attacked: tuple[Path, httpx.Client]) -> None:
    rng, made = random.Random(7), 0
    while made < 1000:
        made += check_attacks(*attacked, (*ATTACKS, "flip", "flip"), rng)


def copied(data: Path, older: Path) -> str:
    test = next(data.glob("tests/*"))
    shutil.copytree(test, test.with_name("t000900-abcdef"))
    return "tests/t000900-abcdef/manifest.json"


def put_back(data: Path, older: Path) -> str:
    test = next(data.glob("tests/*"))
    shutil.rmtree(test)
    shutil.copytree(older / test.relative_to(data), test)
    return f"tests/{test.name}/manifest.json"


def calibration_changed(data: Path, older: Path) -> str:
    path = next(data.glob("tests/*/calibration.json"))
    path.write_text(re.sub(r'("cx_px": )130\.4', r"\g<1>140.4", path.read_text()))
    return path.relative_to(data).as_posix()


@pytest.mark.fault(57)
@pytest.mark.parametrize("attack", [copied, put_back, calibration_changed])
def test_a_folder_that_was_copied_or_put_back_while_the_service_was_away_is_named(
    data: Path, written: Path, attack: Callable[[Path, Path], str]
) -> None:
    test_id, analysis = next(data.glob("tests/*")).name, next(data.glob("tests/*/analyses/*")).name
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            client.patch(f"{API}/tests/{test_id}", json={"name": "later"}, headers={"If-Match": "*"}).raise_for_status()
    finally:
        service.close()
    assert verify(data).findings == ()
    named = attack(data, written)
    assert [finding.path for finding in verify(data).findings if finding.level == "damaged"] == [named]
    service = Service(parse_config(SMALL), data).start()
    try:
        with served(service) as client:
            listed: list[Any] = client.get(f"{API}/tests").json()["tests"]
            assert len(listed) == len({one["id"] for one in listed})
            of = named.split("/")[1]
            answer = client.get(f"{API}/tests/{of}/analyses/{analysis}/steps/1/positions/cam2")
            assert answer.status_code == 409
            assert answer.json()["code"] == ("folder_copied" if attack is copied else "checksum_mismatch")
            assert client.get(f"{API}/tests/{new_test(client)}").status_code == 200
    finally:
        service.close()


def without_manifests(data: Path) -> None:
    """Make a data folder one of the program before there were manifests."""
    for path in [*data.rglob("manifest.json"), *data.rglob("manifest")]:
        path.unlink() if path.is_file() else shutil.rmtree(path)
    (data / "format.json").write_text('{"format": 1, "written_by": "stereorig"}')
    for path in data.glob("catalog.sqlite*"):
        path.unlink()


@pytest.mark.fault(10)
def test_a_folder_of_the_format_before_gets_its_manifests_and_the_number_moves_with_them(data: Path) -> None:
    without_manifests(data)
    result, bare = sorted(data.glob("tests/*/analyses/*/step_*.nc"))[:2]
    bare.with_name(f"{bare.name}.sha256").unlink()
    result.write_bytes(result.read_bytes()[:-1] + b"?")  # damaged before: that is not forgotten
    assert repair(data).after.unknown == 1
    assert '"format": 2' in (data / "format.json").read_text()
    found = verify(data)
    assert [finding.path for finding in found.findings] == [result.relative_to(data).as_posix()]
    assert found.unknown == 1
    next(data.glob("tests/*/manifest.json")).unlink()
    assert any(f.path.endswith("manifest.json") and f.level == "damaged" for f in verify(data).findings)
