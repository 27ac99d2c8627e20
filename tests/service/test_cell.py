"""Foreign files are read in a process that can open nothing: what it may not, and what becomes of what it does."""

from __future__ import annotations

import io
import json
import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import httpx
import numpy as np
import psutil
import pytest
import tifffile

from stereorig.core.errors import Cancelled, FileFormatError, ImageError, StereorigError
from stereorig.server.base.errors import QueueFullError, TooLargeError
from stereorig.server.cell.cell import Cell
from stereorig.server.cell.images import images
from stereorig.server.cell.models import described
from stereorig.server.cell.sandbox import FLOOR_BYTES, ReadingLimits
from stereorig.server.cell.tables import calibration, channels
from stereorig.server.doctor.access import check_cell
from stereorig.server.doctor.report import Notebook
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.channel_table import read_channel_table
from stereorig.server.formats.images import decode
from stereorig.server.formats.models.read import ending_of, read_model
from stereorig.server.workflows.service import Service
from tests.support import naive_readers as naive
from tests.support.patience import Deadline
from tests.support.service_rig import new_test, served, tiny_config

API = "/api/v1"
ELSEWHERE = ["external storage", "external link", "virtual data set"]
SECRET = "the word of another file, 0123456789"
QUICK = ReadingLimits(memory_bytes=256 << 20, cpu_s=1, wall_s=60.0, reply_bytes=16 << 20)
pytestmark = pytest.mark.skipif(os.uname().sysname != "Linux", reason="the walls are Linux's")


@pytest.fixture(scope="module")
def cell() -> Iterator[Cell]:
    made = Cell()
    yield made
    made.close()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    running = Service(tiny_config(), tmp_path_factory.mktemp("cell") / "data").start()
    yield running
    running.close()


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with served(service) as one:
        yield one


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret"
    path.write_text(SECRET)
    return path


def outcome(cell: Cell, *args: object, limits: ReadingLimits = QUICK) -> StereorigError:
    with pytest.raises(StereorigError) as caught:
        cell.read(*args, limits=limits)  # type: ignore[arg-type]
    return caught.value


def test_values_and_arrays_come_back_as_they_were(cell: Cell, secret: Path) -> None:
    assert cell.read(naive.content, [b"bytes", secret]) == ["bytes", SECRET]
    found, made = cell.read(naive.values, []), naive.values([])
    assert found["plain"] == made["plain"]
    for name in set(made) - {"plain"}:
        np.testing.assert_array_equal(found[name], made[name])
        assert (found[name].dtype, found[name].shape) == (made[name].dtype, made[name].shape)


def test_a_reader_has_every_wall_of_this_kernel(cell: Cell) -> None:
    assert cell.read(naive.walls, []) == ["limits", "Landlock", "seccomp"]


@pytest.mark.fault(55)
@pytest.mark.parametrize(("attack", "given"), naive.ATTACKS, ids=lambda v: getattr(v, "__name__", None))
def test_a_reader_can_open_start_and_reach_nothing(
    cell: Cell, secret: Path, attack: object, given: tuple[str, ...]
) -> None:
    places = {"secret": str(secret), "new": str(secret.parent / "new"), "folder": str(secret.parent)}
    args = [{**places, "port": 80, "pid": os.getpid()}[name] for name in given]
    error = outcome(cell, attack, [b"its own"], *args)
    assert error.code == "file_harmful"
    assert SECRET not in str(error)
    assert [path.name for path in secret.parent.iterdir()] == ["secret"]
    assert secret.read_text() == SECRET


def foreign_hdf5(path: Path, secret: Path, kind: str) -> bytes:
    """Return an HDF5 file whose data set ``w`` lies in another file."""
    size = len(SECRET)
    other = secret.with_suffix(".h5")
    if kind != "external storage":
        with h5py.File(other, "w") as file:
            file["w"] = np.frombuffer(SECRET.encode(), np.uint8)
    with h5py.File(path, "w") as file:
        if kind == "external storage":
            file.create_dataset("w", (size,), np.uint8, external=[(str(secret), 0, size)])
        elif kind == "external link":
            file["w"] = h5py.ExternalLink(str(other), "/w")
        else:
            layout = h5py.VirtualLayout((size,), np.uint8)
            layout[:] = h5py.VirtualSource(str(other), "w", (size,))
            file.create_virtual_dataset("w", layout)
    return path.read_bytes()


@pytest.mark.fault(55)
@pytest.mark.parametrize("kind", ELSEWHERE)
def test_hdf5_that_names_another_file_shows_nothing_of_it(cell: Cell, secret: Path, kind: str) -> None:
    content = foreign_hdf5(secret.with_name("heavy.h5"), secret, kind)
    assert SECRET in str(naive.hdf5_numbers([io.BytesIO(content)]))  # without the cell the file is followed
    assert outcome(cell, naive.hdf5_numbers, [content]).code == "file_harmful"
    try:
        found = cell.read(naive.hdf5_numbers, [content], False)
    except FileFormatError as error:
        found = str(error)
    assert SECRET[:4] not in str(found)


@pytest.mark.fault(56)
@pytest.mark.parametrize(
    ("reader", "code"),
    [
        (naive.crashes, "file_harmful"),
        (naive.gives_up, "file_harmful"),
        (naive.ends_without_a_word, "file_harmful"),
        (naive.fails, "file_harmful"),
        (naive.refuses_strangely, "file_harmful"),
        (naive.grows, "file_too_large"),
        (naive.replies_at_length, "file_too_large"),
        (naive.turns, "file_too_large"),
    ],
    ids=lambda v: getattr(v, "__name__", v),
)
def test_a_crash_or_a_limit_is_one_coded_problem_and_the_next_file_is_read(
    cell: Cell, reader: object, code: str
) -> None:
    keeper = cell.read(naive.content, [b"before"]) and cell.pid
    error = outcome(cell, reader, [b"x"])
    assert error.code == code
    assert "secret" not in str(error)
    assert isinstance(error, TooLargeError if code == "file_too_large" else FileFormatError)
    assert cell.read(naive.content, [b"after"]) == ["after"]
    assert cell.pid == keeper


@pytest.mark.fault(56)
def test_a_reader_that_waits_is_ended_by_the_clock(cell: Cell) -> None:
    assert outcome(cell, naive.waits, [b"x"], limits=ReadingLimits(wall_s=1.0)).code == "file_too_large"


def test_a_readers_own_refusal_comes_back_whole(cell: Cell) -> None:
    error = outcome(cell, naive.refuses, [])
    assert (type(error), error.code, error.cause) == (ImageError, "image_blank", "It is blank.")
    assert (error.remedy, error.context) == ("Take another.", {"camera": "cam1"})


@pytest.mark.fault(56)
def test_memory_is_bounded_by_the_declared_size(cell: Cell) -> None:
    declared = 20 << 20
    assert cell.read(naive.declares, [], declared, 3 * declared) == 1
    assert outcome(cell, naive.declares, [], declared, FLOOR_BYTES + 5 * declared, limits=ReadingLimits()).code == (
        "file_too_large"
    )


def _head(document: object, more: bytes = b"") -> bytes:
    text = json.dumps(document).encode()
    return struct.pack("<Q", len(text)) + text + more


@pytest.mark.fault(55)
@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"abc",
        struct.pack("<Q", 1 << 60),
        _head([1]),
        _head({"value": {"array": ["<f8", 1 << 62, 1 << 62]}}),
        _head({"value": {"array": ["<f8", -1]}}),
        _head({"value": {"array": ["O", 1]}}, bytes(64)),
        _head({"value": {"array": ["<f8", 1.5]}}, bytes(64)),
        _head({"value": {"array": ["<f8", 1, 1, 1, 1, 1]}}, bytes(64)),
        _head({"error": {"kind": "SystemExit", "code": "image_blank", "cause": "", "remedy": "", "context": {}}}),
        _head({"error": {"kind": "DeviceError", "code": "image_blank", "cause": "", "remedy": "", "context": {}}}),
        _head({"error": {"kind": "InputError", "code": "image_blank", "cause": "", "remedy": "", "context": 3}}),
        b"\xff" * 100,
        struct.pack("<Q", 200_000) + b"[" * 200_000,
    ],
)
def test_a_reply_of_an_attacker_is_refused(cell: Cell, raw: bytes) -> None:
    assert outcome(cell, naive.replies_with, [b"x"], raw).code in ("file_harmful", "file_too_large")


def test_a_dead_keeper_is_started_again_and_its_readers_end(cell: Cell) -> None:
    with ThreadPoolExecutor(1) as pool:
        cell.read(naive.content, [])
        waiting = pool.submit(outcome, cell, naive.waits, [b"x"], limits=ReadingLimits(wall_s=5.0))
        keeper = psutil.Process(cell.pid)
        deadline = Deadline(60.0)
        while not keeper.children() and deadline.left:
            time.sleep(0.01)
        children = keeper.children()
        keeper.kill()
        assert cell.read(naive.content, [b"again"]) == ["again"]
        assert psutil.wait_procs(children, timeout=60.0)[1] == []
        assert waiting.result().code == "file_too_large"  # begun again by the next keeper, and ended by the clock
    assert cell.pid != keeper.pid


@pytest.mark.fault(56)
def test_files_are_read_at_once_and_too_many_are_refused() -> None:
    cell = Cell()
    errors: list[StereorigError] = []

    def wait() -> None:
        try:
            cell.read(naive.waits, [b"x"])
        except StereorigError as error:
            errors.append(error)

    threads = [threading.Thread(target=wait) for _ in range(20)]
    for thread in threads:
        thread.start()
    deadline = Deadline(60.0)
    while (len(errors) < 4 or len(psutil.Process(cell.pid).children()) < 4) and deadline.left:
        time.sleep(0.01)
    assert len(psutil.Process(cell.pid).children()) == 4
    assert [error.code for error in errors] == ["reads_waiting"] * 4
    assert isinstance(errors[0], QueueFullError)
    cell.close()
    for thread in threads:
        thread.join(60.0)
    assert [type(error) for error in errors[4:]] == [Cancelled] * 16
    with pytest.raises(Cancelled):
        cell.read(naive.content, [])


def test_the_keeper_ends_with_the_service_and_has_none_of_its_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREORIG_KEY", SECRET)
    cell = Cell()
    assert cell.pid is None  # started by the first file
    cell.read(naive.content, [])
    keeper = psutil.Process(cell.pid)
    assert SECRET not in keeper.environ().values()
    cell.close()
    assert not keeper.is_running()


@pytest.mark.parametrize(("lacking", "state"), [([], "ok"), (["Landlock"], "warning")])
def test_the_doctor_names_the_walls(monkeypatch: pytest.MonkeyPatch, lacking: list[str], state: str) -> None:
    held = [name for name in ("limits", "Landlock", "seccomp") if name not in lacking]
    if lacking:  # as in a container that does not allow it
        monkeypatch.setattr(Cell, "read", lambda *_: held)
    book = Notebook()
    check_cell(book)
    assert [(check.name, check.state) for check in book.checks] == [("foreign files", state)]
    assert all(name in book.checks[0].found for name in held + lacking)


# over HTTP ---------------------------------------------------------------------------------------------------------


def pair_of(content: bytes) -> dict[str, tuple[str, bytes]]:
    return {"cam1": ("a.tif", content), "cam2": ("b.tif", content)}


def strip_bomb() -> bytes:
    """Return a TIFF of 16 by 16 pixels whose one strip unpacks to 1 GiB."""
    import zlib

    packer = zlib.compressobj(9)
    block = bytes(1 << 20)
    packed = b"".join(packer.compress(block) for _ in range(1 << 10)) + packer.flush()
    plain = io.BytesIO()
    tifffile.imwrite(plain, np.arange(256, dtype=np.uint8).reshape(16, 16), compression="zlib")
    made = bytearray(plain.getvalue())
    with tifffile.TiffFile(io.BytesIO(bytes(made))) as file:
        tags = file.pages[0].aspage().tags
        for name, value in (("StripOffsets", len(made)), ("StripByteCounts", len(packed))):
            struct.pack_into("<I" if tags[name].dtype == 4 else "<H", made, tags[name].valueoffset, value)
    return bytes(made) + packed


@pytest.mark.fault(56)
def test_a_decoder_bomb_takes_no_memory_of_the_service(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    before = psutil.Process().memory_info().rss
    answer = client.post(f"{API}/tests/{test_id}/steps:import", files=pair_of(strip_bomb()))
    assert answer.status_code in (413, 422), answer.text
    assert psutil.Process().memory_info().rss - before < 64 << 20
    assert client.get(f"{API}/tests/{test_id}/steps").json()["steps"] == []


@pytest.mark.fault(56)
def test_xml_that_ends_its_reader_is_a_refusal(client: httpx.Client, cell: Cell) -> None:
    deep = f"<?xml version='1.0'?><opencv_storage>{'<a>' * 300_000}".encode()
    assert outcome(cell, naive.xml, [deep]).code == "file_harmful"  # SIGSEGV: that of a service without a cell
    sent = deep.replace(b"<a>", b"<cameraMatrix1>", 1)
    answer = client.post(f"{API}/calibrations:import", files={"file": ("c.xml", sent)})
    assert answer.status_code == 422
    assert client.get(f"{API}/healthz").status_code == 200


@pytest.mark.fault(55)
@pytest.mark.parametrize("kind", ELSEWHERE)
def test_a_model_whose_heavy_data_lie_elsewhere_is_refused(
    client: httpx.Client, secret: Path, tmp_path: Path, kind: str
) -> None:
    heavy = foreign_hdf5(tmp_path / "m.h5", secret, kind)
    text = """<Xdmf><Domain><Grid><Topology TopologyType="Triangle" NumberOfElements="1"><DataItem Format="HDF"
        Dimensions="3" NumberType="UChar">m.h5:/w</DataItem></Topology><Geometry GeometryType="XYZ"><DataItem
        Format="XML" Dimensions="3 3">0 0 0 1 0 0 0 1 0</DataItem></Geometry><Attribute Name="u" Center="Node"
        AttributeType="Vector"><DataItem Format="XML" Dimensions="3 3">0 0 0 0 0 0 0 0 0</DataItem></Attribute>
        </Grid></Domain></Xdmf>"""
    test_id = new_test(client)
    answer = client.post(
        f"{API}/tests/{test_id}/models",
        files={"file": ("m.xdmf", text.encode()), "heavy": ("m.h5", heavy)},
        data={"unit": "mm"},
    )
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] in ("model_unreadable", "file_refers_elsewhere", "file_harmful")
    assert str(ord(SECRET[2])) not in answer.json()["detail"]
    assert client.get(f"{API}/tests/{test_id}/models").json()["models"] == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<VTKFile/>",
        "<a><b></a>",
        "<?xml version='1.0' encoding='iso-8859-15'?><Xdmf/>",
        "{",
        "x,y\n1,2\n",
        "\xff\xfe",
        "%YAML:1.0\ncameraMatrix1: 3\n",
        '{"cam1": 1, "cam2": []}',
        "time_s,force [kN]\n0,a\n",
    ],
)
def test_what_a_reader_refuses_by_itself_is_refused_in_the_same_words(cell: Cell, tmp_path: Path, text: str) -> None:
    content = text.encode("latin-1")
    path = tmp_path / f"m{ending_of(content)}"
    path.write_bytes(content)
    ways: list[tuple[Callable[[], object], Callable[[], object]]] = [
        (lambda: decode(content, name="the image"), lambda: images(cell, {"the image": content})),
        (lambda: parse_calibration(content, name="The file"), lambda: calibration(cell, content)),
        (lambda: read_channel_table(content), lambda: channels(cell, content, time_column=None)),
        (lambda: read_model(path), lambda: described(cell, {path.name: path}, path.name, {})),
    ]
    for pair in ways:
        found = []
        for read in pair:
            with pytest.raises(StereorigError) as caught:
                read()
            error = caught.value
            found.append((type(error), error.code, error.cause, error.remedy))
        assert found[0] == found[1]


def test_images_come_through_the_cell_bit_by_bit(cell: Cell) -> None:
    made = np.random.default_rng(1).integers(0, 65536, (40, 60), dtype=np.uint16)
    plain = io.BytesIO()
    tifffile.imwrite(plain, made)
    np.testing.assert_array_equal(images(cell, {"one": plain.getvalue()})["one"].pixels, made)
