"""Images in object storage: ``stereorig measure`` on ``s3://``, against a storage on this machine."""

from __future__ import annotations

import importlib.util
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError, InputError
from stereorig.server.cli.main import main
from stereorig.server.formats.object_storage import copied
from stereorig.sim.world import SimWorld
from tests.support.copied_tests import write_test_of
from tests.support.measure_command import ROI, SIZE, small_rig
from tests.support.requirements import missing
from tests.support.running_analyses import contents

BUCKET = "bench"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    for package in ("s3fs", "moto", "flask"):
        if importlib.util.find_spec(package) is None:
            missing(f"{package} (pip install s3fs 'moto[s3]' flask flask-cors)")
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        yield f"http://{host}:{port}"
    finally:
        server.stop()


@pytest.fixture
def storage(endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """Credentials of one who may read, and nothing of this machine's own."""
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "reader")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3fs.S3FileSystem.clear_instance_cache()
    yield endpoint
    s3fs.S3FileSystem.clear_instance_cache()


def test_a_series_in_a_bucket_is_measured_as_the_same_series_on_the_disk(storage: str, tmp_path: Path) -> None:
    import s3fs

    world = SimWorld(small_rig(), lambda _: 0.0)
    rng, images = np.random.default_rng(3), []
    for n in range(2):
        world.set_scene("plate", load=300.0 * n)
        images.append([world.expose(cam, exposure_ms=10.0, gain_db=0.0, rng=rng) for cam in ("cam1", "cam2")])
    pair: StereoPair = world.true_pair()
    write_test_of(tmp_path / "test", pair, images)
    bucket = s3fs.S3FileSystem()
    bucket.mkdir(BUCKET)
    for n in range(2):
        for cam in ("cam1", "cam2"):
            bucket.put(str(tmp_path / f"test/steps/{n:04d}/{cam}.tif"), f"{BUCKET}/series/{cam}_{n}.tif")
    options = ["--calibration", str(tmp_path / "test/calibration.json"), "--roi", ROI, "--subset", "21"]
    out, there = tmp_path / "out", tmp_path / "there"
    cams = [f"--cam{k}=s3://{BUCKET}/series/cam{k}_*.tif" for k in (1, 2)]
    assert main(["measure", *cams, *options, "--out", str(out)]) == 0
    local = [f"--cam{k}={tmp_path}/test/steps/*/cam{k}.tif" for k in (1, 2)]
    assert main(["measure", *local, *options, "--out", str(there)]) == 0
    one, two = (contents(folder / "step_0001.nc") for folder in (out, there))
    assert (one["status"] == 0).mean() > 0.5
    for name in ("status", "u_mm", "w_mm", "sigma_w_mm"):
        np.testing.assert_array_equal(one[name], two[name])
    assert SIZE[0] > 0
    copies = sorted(path.name for path in (out / "images").rglob("*.tif"))
    assert copies == ["cam1_0.tif", "cam1_1.tif", "cam2_0.tif", "cam2_1.tif"]


def test_an_object_that_is_not_there_is_named(storage: str, tmp_path: Path) -> None:
    for item in (f"s3://{BUCKET}/none.tif", f"s3://{BUCKET}/none_*.tif", "s3://no-such-bucket/a.tif"):
        with pytest.raises(ImageError) as caught:
            copied("--cam1", [item], tmp_path / "images")
        assert caught.value.code == "file_missing"
        assert item.split("://")[1] in str(caught.value)


def test_no_credentials_are_said_to_be_missing(storage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(ImageError) as caught:
        copied("--cam1", [f"s3://{BUCKET}/series/cam1_0.tif"], tmp_path / "images")
    assert caught.value.code == "object_forbidden"
    assert "AWS_ACCESS_KEY_ID" in caught.value.remedy


def test_a_read_that_is_cut_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, storage: str) -> None:
    """A storage that promises 1,000 bytes and closes the connection after 400."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            with client:
                head = client.recv(65536)
                client.sendall(
                    b'HTTP/1.1 200 OK\r\nContent-Length: 1000\r\nETag: "x"\r\nConnection: close\r\n'
                    b"Last-Modified: Wed, 01 Jan 2025 00:00:00 GMT\r\n\r\n"
                )
                if not head.startswith(b"HEAD"):
                    client.sendall(b"x" * 400)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{listener.getsockname()[1]}")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    try:
        with pytest.raises(ImageError) as caught:
            copied("--cam1", [f"s3://{BUCKET}/a.tif"], tmp_path / "images")
    finally:
        listener.close()
    assert caught.value.code == "object_cut"
    assert not list((tmp_path / "images").iterdir())


def test_a_storage_whose_package_is_missing_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        copied("--cam1", ["gs://bucket/a.tif"], tmp_path / "images")
    assert caught.value.code in ("storage_package_missing", "address_unknown")
    with pytest.raises(InputError) as caught:
        copied("--cam1", ["nonsense://bucket/a.tif"], tmp_path / "images")
    assert caught.value.code == "address_unknown"


def test_two_objects_of_one_name_are_refused(tmp_path: Path) -> None:
    """By the storage in memory, which needs no package."""
    import fsspec

    memory = fsspec.filesystem("memory")
    for folder in ("a", "b"):
        memory.pipe(f"/{folder}/cam1.tif", b"x")
    with pytest.raises(InputError) as caught:
        copied("--cam1", ["memory://a/cam1.tif", "memory://b/cam1.tif"], tmp_path / "images")
    assert caught.value.code == "same_name"
