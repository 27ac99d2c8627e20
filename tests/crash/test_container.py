"""The container file builds, and its image works as nobody in particular on a file system that cannot be written."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.container import Image

pytestmark = [pytest.mark.deep, pytest.mark.delivered, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Image]:
    with contextlib.ExitStack() as stack:
        folder = tmp_path_factory.mktemp("image")
        made = Image(folder)
        stack.callback(made.close)
        yield made


def test_it_runs_as_a_user_of_its_own_and_can_write_to_its_volumes_alone(image: Image, tmp_path: Path) -> None:
    look = "id -u; touch /data/x && echo data; touch /opt/stereorig/x /etc/x || true; grep CapEff /proc/self/status"
    done = image.run("sh", "-c", look, data=tmp_path / "data")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["10001", "data", "CapEff:", "0000000000000000"]
    assert done.stderr.count("Read-only file system") == 2


def test_doctor_calls_it_good_and_finds_the_kernels_of_the_build(image: Image, tmp_path: Path) -> None:
    done = image.run("stereorig", "doctor", "--seconds", "0.5", "--data", "/data", data=tmp_path / "data")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "there already (/var/cache/stereorig)" in done.stdout


def test_the_demo_finds_the_plate_and_compiles_no_kernel_of_a_measurement(image: Image, tmp_path: Path) -> None:
    done = image.run("stereorig", "demo", "--out", "/data/demo", data=tmp_path / "data", seconds=500.0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "18 of 18 figures within their limits" in done.stdout
    # numba goes there where the image's own folder cannot be written
    assert not (tmp_path / "data" / ".cache").exists()
    log = (tmp_path / "data" / "demo" / "service.log").read_text()
    assert "compiling" not in log, log
