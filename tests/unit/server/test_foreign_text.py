"""Calibrations and models as text that no program writes: a coded refusal, whatever stands in it."""

from __future__ import annotations

import base64
import json
import lzma
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path
from xml.etree import ElementTree

import pytest

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.formats.calibrations.recognise import imported_content, parse_calibration
from stereorig.server.formats.models.read import read_model
from stereorig.server.formats.models.vtu import read_vtu
from stereorig.server.formats.models.xdmf import read_xdmf
from stereorig.server.formats.xml_tree import read_xml

CAMERA = {"fx_px": 1e3, "fy_px": 1e3, "cx_px": 1.0, "cy_px": 1.0}
CAMERA |= {"alpha_rad": 0.0, "beta_rad": 0.0, "gamma_rad": 0.0, "x0_mm": 0.0, "y0_mm": 0.0, "z0_mm": 400.0}
OPENCV = {
    "cameraMatrix1": [[1e3, 0, 1], [0, 1e3, 1], [0, 0, 1]],
    "cameraMatrix2": [[1e3, 0, 1], [0, 1e3, 1], [0, 0, 1]],
    "distCoeffs1": [0, 0, 0, 0, 0],
    "distCoeffs2": [0, 0, 0, 0, 0],
    "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "T": [100, 0, 0],
}


def _own(**more: object) -> bytes:
    return json.dumps({"cam1": CAMERA, "cam2": {**CAMERA, "x0_mm": 100.0}, **more}).encode()


def _opencv(**more: object) -> bytes:
    return json.dumps({**OPENCV, **more}).encode()


@pytest.mark.fault(52)
@pytest.mark.parametrize(
    "data",
    [
        _own(cam2={**CAMERA, "x0_mm": 10**400}),
        _own(cam2={**CAMERA, "x0_mm": 10**30}),
        _own(cam2={**CAMERA, "x0_mm": 1e308}),
        _own(note="\ud800"),
        _own(cam2={**CAMERA, "x0_mm": {"a": 1}}),
        b'{"imported": {"text": "cameraMatrix1 \\ud800"}}',
        _opencv(T=[10**400, 0, 0]),
        _opencv(T={"rows": 3, "cols": 10**30, "data": [1, 2, 3]}),
        _opencv(T={"rows": -1, "cols": -3, "data": [1, 2, 3]}),
        _opencv(T={"sizes": [], "data": []}),
        _opencv(T={"rows": 3, "cols": 1}),
        _opencv(imageSize=[10**400, 1]),
        _opencv(imageSize=[1e308, 1]),
        _opencv(imageSize=[]),
        b"cameraMatrix1: !!bool x\n",
        b"cameraMatrix1: !!timestamp x\n",
        b"? [a]\n: 1\ncameraMatrix1: 2\n",
        b"a: &a {k: 1}\ncameraMatrix1: {<<: [*a, *a]}\n",
        _opencv(T=["\u0661\u0662", 0, 0]),
    ],
    ids=lambda data: data[:60].decode("latin-1") if len(data) < 100 else str(len(data)),
)
def test_numbers_and_texts_of_no_calibration_are_refused_by_a_code(data: bytes) -> None:
    with pytest.raises(FileFormatError) as caught:
        json.dumps(imported_content(data, name="a"), ensure_ascii=False).encode()
    assert caught.value.code in ("calibration_unreadable", "calibration_invalid")
    assert len(str(caught.value)) < 500


def test_the_same_files_without_the_fault_are_read() -> None:
    assert parse_calibration(_own(), name="a").pair.baseline_mm == pytest.approx(100)
    assert parse_calibration(_opencv(imageSize=[640, 480]), name="a").image_size1_px == (640, 480)


@pytest.mark.fault(56)
def test_a_megabyte_of_xml_ends_no_process() -> None:
    """OpenCV's own reader of XML ended the process with a broken stack."""
    code = """
import sys
from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.formats.calibrations.recognise import parse_calibration
for body in (b"<a>" * 300_000, b"<_>" * 300_000 + b"1" + b"</_>" * 300_000, b"<a/>" * 250_000, b"<!--" * 200_000):
    for head in (b"<a><cameraMatrix1>", b"<calibration><camera><orientation>", b"<ParameterList name='CAMERA'>"):
        try:
            parse_calibration(b"<?xml version='1.0'?>" + head + body, name="a")
        except FileFormatError as error:
            print(error.code)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0
    assert set(run.stdout.split()) == {"calibration_unreadable"}


@pytest.mark.fault(55)
@pytest.mark.fault(56)
@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
        '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/hostname">]><a>&b;</a>',
        '<!DOCTYPE a [<!ENTITY % b SYSTEM "http://127.0.0.1/">%b;]><a/>',
        '<!DOCTYPE a SYSTEM "/etc/hostname"><a>&unknown;</a>',
        '<a xmlns:x="http://www.w3.org/2001/XInclude"><x:include href="/etc/hostname" parse="text"/></a>',
        "<a>" * 65 + "</a>" * 65,
        "<a>" + "<b/>" * 300_001 + "</a>",
        '<?xml version="1.0" encoding="no-such"?><a/>',
        "<a><b></a></b>",
        "",
        "text",
    ],
    ids=lambda text: text[:50],
)
def test_xml_that_names_others_or_never_ends_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        read_xml(text.encode())
    assert Path("/etc/hostname").read_text().strip() not in str(caught.value)
    for read in (read_vtu, lambda data: read_xdmf(data, lambda _: pytest.fail("a file was asked for"))):
        with pytest.raises(FileFormatError) as refused:
            read(text.encode())
        assert refused.value.code == "model_unreadable"


@pytest.mark.parametrize(
    "text",
    [
        "<a/>",
        '<a x="1" y="&lt;">b<c d="2">e</c>f<c/>g</a>',
        '<?xml version="1.0" encoding="ISO-8859-1"?><a>\xe9</a>',
        '<a xmlns="urn:n" xmlns:p="urn:q" p:x="1"><p:b/></a>',
        "<a><![CDATA[<&>]]></a>",
    ],
)
def test_a_tree_is_as_the_standard_library_reads_it(text: str) -> None:
    data = text.encode("latin-1")
    assert ElementTree.tostring(read_xml(data)) == ElementTree.tostring(ElementTree.fromstring(data))


def test_a_document_type_may_be_named() -> None:
    assert read_xml(b'<!DOCTYPE Xdmf SYSTEM "Xdmf.dtd" []><Xdmf/>').tag == "Xdmf"
    assert read_xml(b"<!DOCTYPE vpml><vpml/>").tag == "vpml"


VTU = (
    '<VTKFile type="UnstructuredGrid"{head}><UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1"><Points>'
    '<DataArray type="Float64" NumberOfComponents="3" {points}</DataArray></Points><Cells>'
    '<DataArray type="Int64" Name="connectivity" format="ascii">{nodes}</DataArray>'
    '<DataArray type="Int64" Name="offsets" format="ascii">3</DataArray>'
    '<DataArray type="UInt8" Name="types" format="ascii">5</DataArray></Cells><PointData>'
    '<DataArray type="Float64" Name="U" NumberOfComponents="{parts}" format="ascii">{moved}</DataArray>'
    "</PointData></Piece></UnstructuredGrid></VTKFile>"
)
WHOLE = {
    "head": "",
    "points": 'format="ascii">0 0 0 1 0 0 0 1 0 9 9 9',
    "nodes": "0 1 2",
    "parts": "3",
    "moved": "0 0 0 0 0 0 0 0 0 nan nan nan",  # of a node that no cell has
}


def _model(tmp_path: Path, **changes: str) -> str:
    (tmp_path / "m.vtu").write_text(VTU.format(**{**WHOLE, **changes}))
    try:
        read_model(tmp_path / "m.vtu", unit="mm")
    except StereorigError as error:
        return str(error)
    return "read"


@pytest.mark.fault(52)
def test_numbers_in_a_model_s_file_that_no_program_writes_are_refused_by_a_code(tmp_path: Path) -> None:
    assert _model(tmp_path) == "read"
    for parts in ("x", "5" * 5000, "-3", "\u0663", "1e3"):
        assert _model(tmp_path, parts=parts).startswith("model_unreadable: ")
    for nodes in ("0 1 4", "0 1 -1", "0 1 9999999999"):
        found = _model(tmp_path, nodes=nodes)
        assert found.startswith("model_unreadable: ")
        assert "9999999999" not in found
    for odd in ("nan", "inf", "-1e308"):
        found = _model(tmp_path, moved=f"0 0 0 {odd} 0 0 0 0 0 0 0 0")
        assert found.startswith("model_invalid: 1 of 4 nodes have displacements")
        assert "first node 2" in found
        found = _model(tmp_path, points=f'format="ascii">0 0 0 1 0 0 0 1 {odd} 9 9 {odd}')
        assert found.startswith("model_invalid: 2 of 4 nodes have positions")
        assert "first node 3" in found


@pytest.mark.fault(56)
@pytest.mark.parametrize("compressor", ["vtkZLibDataCompressor", "vtkLZMADataCompressor"])
def test_a_block_of_no_bytes_is_no_block_without_limit(tmp_path: Path, compressor: str) -> None:
    grown = bytes(50_000_000)
    packed = zlib.compress(grown) if "ZLib" in compressor else lzma.compress(grown, preset=0)
    for blocks in ((1, 0, 0), (1, 96, 0), (1, 96, 95), (2, 48, 0)):
        head = struct.pack(f"<{3 + blocks[0]}I", *blocks, *[len(packed)] * blocks[0])
        text = base64.b64encode(head).decode() + base64.b64encode(packed * blocks[0]).decode()
        tracemalloc.start()
        found = _model(tmp_path, head=f' compressor="{compressor}"', points=f'format="binary">{text}')
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
        tracemalloc.stop()
        assert found.startswith("model_unreadable: ")
