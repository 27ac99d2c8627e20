"""Finite element results as other programs write them; what is refused, and how it is said."""

from __future__ import annotations

import contextlib
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from pyvista import from_meshio
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.core.model.surface import ModelSurface
from stereorig.server.formats.models.read import read_model
from tests.support.model_bench import kirsch, mesh, write_model

TOWARDS = np.array([0.0, 0.0, 1.0])
CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float)
HEAD = "x_mm,y_mm,z_mm,u_mm,v_mm,w_mm\n"
ROWS = "0,0,0,0.1,0,0\n1,0,0,0.1,0,0\n0,1,0,0.1,0,0\n1,1,0,0.1,0,0\n"


@pytest.fixture(scope="module")
def surface() -> ModelSurface:
    return mesh(kirsch(), half_mm=3.0, spacing_mm=0.5)


def same(path: Path, surface: ModelSurface, unit: str | None = "mm") -> None:
    read = read_model(path, unit=unit).surface(TOWARDS)  # type: ignore[arg-type]
    np.testing.assert_allclose(read.nodes_mm, surface.nodes_mm, atol=1e-9)
    np.testing.assert_allclose(read.displacement_mm, surface.displacement_mm, atol=1e-12)
    np.testing.assert_array_equal(read.triangles, surface.triangles)


@pytest.mark.parametrize("mode", [0, 1, 2])
@pytest.mark.parametrize("text", [0, 1])
@pytest.mark.parametrize("packed", ["None", "ZLib", "LZMA"])
def test_vtk_s_own_files_are_read_in_every_form(
    mode: int, text: int, packed: str, surface: ModelSurface, tmp_path: Path
) -> None:
    grid = from_meshio(
        meshio.Mesh(surface.nodes_mm, [("triangle", surface.triangles)], {"displacement": surface.displacement_mm})
    )
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(tmp_path / "m.vtu"))
    writer.SetInputData(grid)
    writer.SetDataMode(mode)
    writer.SetEncodeAppendedData(text)
    getattr(writer, f"SetCompressorTypeTo{packed}")()
    assert writer.Write()
    same(tmp_path / "m.vtu", surface)


@pytest.mark.parametrize("form", ["XML", "HDF"])
def test_xdmf_is_read_with_its_heavy_data(form: str, surface: ModelSurface, tmp_path: Path) -> None:
    made = meshio.Mesh(surface.nodes_mm, [("triangle", surface.triangles)], {"U": surface.displacement_mm})
    meshio.write(tmp_path / "m.xdmf", made, data_format=form)
    same(tmp_path / "m.xdmf", surface)
    if form == "HDF":
        (tmp_path / "m.h5").unlink()
        with pytest.raises(FileFormatError, match=r"m\.h5 are not in its folder"):
            read_model(tmp_path / "m.xdmf", unit="mm")


def test_a_series_gives_the_state_asked_for(
    surface: ModelSurface, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where this writer puts heavy data
    with meshio.xdmf.TimeSeriesWriter(tmp_path / "m.xdmf") as out:
        out.write_points_cells(surface.nodes_mm, [("triangle", surface.triangles)])
        for time in (0.0, 1.0, 2.0):
            out.write_data(time, point_data={"displacement": time * surface.displacement_mm})
    for asked, factor in ((None, 2.0), (1.1, 1.0), (0.0, 0.0)):
        read = read_model(tmp_path / "m.xdmf", unit="mm", time=asked)
        np.testing.assert_allclose(read.displacement_mm, factor * surface.displacement_mm, atol=1e-12)


def test_heavy_data_elsewhere_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["points"] = np.zeros((3, 3))
    for name in ("../secret.h5", str(tmp_path / "secret.h5")):
        text = (
            '<Xdmf><Domain><Grid><Geometry GeometryType="XYZ"><DataItem Format="HDF" Dimensions="3 3">'
            f"{name}:/points</DataItem></Geometry></Grid></Domain></Xdmf>"
        )
        (tmp_path / "in" / "m.xdmf").write_text(text)
        with pytest.raises(FileFormatError, match="only files in the same folder are read"):
            read_model(tmp_path / "in" / "m.xdmf", unit="mm")


@pytest.mark.parametrize(
    ("kind", "order"),
    [("tetra", None), ("hexahedron", None), ("wedge", None), ("tetra10", "quadratic"), ("hexahedron20", "quadratic")],
)
def test_of_solids_the_side_that_is_seen_is_compared(kind: str, order: str | None, tmp_path: Path) -> None:
    hexahedron = np.arange(8)[None]
    tets = np.array([[0, 1, 3, 4], [1, 2, 3, 6], [1, 3, 4, 6], [3, 4, 6, 7], [1, 4, 5, 6]])
    cells = {"tetra": tets, "hexahedron": hexahedron, "wedge": np.array([[0, 1, 3, 4, 5, 7], [1, 2, 3, 5, 6, 7]])}
    edges = {
        "tetra10": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
        "hexahedron20": (
            *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
        ),
    }
    points, nodes = CUBE, cells[kind.rstrip("0123456789")]
    if order is not None:  # a node of its own in the middle of each edge; solids share them by position
        middles = np.array([[points[[c[a], c[b]]].mean(axis=0) for a, b in edges[kind]] for c in nodes])
        points, back = np.unique(np.concatenate([CUBE, middles.reshape(-1, 3)]), axis=0, return_inverse=True)
        first = back.ravel()[:8]
        nodes = np.concatenate([first[nodes], back.ravel()[8:].reshape(len(nodes), -1)], axis=1)
    lift = np.column_stack([np.zeros((len(points), 2)), points[:, 2] + 0.5])
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(points, [(kind, nodes)], {"displacement": lift}))
    read = read_model(tmp_path / "m.vtu", unit="mm")
    for towards, height in ((1.0, 1.0), (-1.0, 0.0)):
        side = read.surface(np.array([0.0, 0.0, towards]))
        assert side.area_mm2.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(side.nodes_mm[side.triangles][..., 2], height)
        feet = side.feet(np.array([[0.4, 0.3, height]]))
        assert side.displacement_at(feet)[0, 2] == pytest.approx(height + 0.5)


def test_a_table_is_joined_to_a_surface_that_leaves_its_hole_open(tmp_path: Path) -> None:
    whole = mesh(kirsch(), half_mm=6.0, hole_mm=2.0)
    rows = np.column_stack([whole.nodes_mm, whole.displacement_mm])
    np.savetxt(tmp_path / "m.csv", rows, delimiter=";", header="X [mm];Y [mm];Z [mm];Ux [mm];Uy [mm];Uz [mm]")
    read = read_model(tmp_path / "m.csv").surface(TOWARDS)
    assert read.area_mm2.sum() == pytest.approx(whole.area_mm2.sum(), rel=1e-3)
    feet = read.feet(np.zeros((1, 3)))
    assert feet.beyond_mm[0] == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize(("unit", "per_mm"), [("m", 1e-3), ("in", 1 / 25.4), ("um", 1e3), ("cm", 0.1)])
def test_lengths_of_every_unit_become_millimetres(
    unit: str, per_mm: float, surface: ModelSurface, tmp_path: Path
) -> None:
    same(write_model(tmp_path / "m.vtu", surface, per_mm=per_mm), surface, unit)


def test_a_unit_in_the_file_is_taken_and_another_refused(surface: ModelSurface, tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.vtu", surface, per_mm=1e-3)
    label = b'<InformationKey name="UNITS_LABEL" location="vtkDataArray">m</InformationKey></DataArray>'
    path.write_bytes(path.read_bytes().replace(b"</DataArray>", label))
    same(path, surface, None)
    with pytest.raises(StereorigError) as raised:
        read_model(path, unit="mm")
    assert raised.value.code == "model_unit_conflict"
    assert "states m" in raised.value.cause


@pytest.mark.parametrize(
    ("name", "content", "code", "said"),
    [
        ("m.csv", HEAD.replace("_mm", "") + ROWS, "model_unit_missing", "no unit of length"),
        ("m.csv", HEAD.replace("x_mm", "x_m") + ROWS, "model_unreadable", "different units"),
        ("m.csv", HEAD.replace(",w_mm", "") + ROWS, "model_unreadable", "6 cells under 5 titles"),
        ("m.csv", HEAD.replace(",u_mm,v_mm", ",p,q") + ROWS, "model_unreadable", "no column u"),
        ("m.csv", HEAD.replace("y_mm", "q") + ROWS, "model_unreadable", "no column y"),
        ("m.csv", "x_mm,y_mm,z_mm,u_mm,v_mm\n0,0,0,1,1\n1,0,0,1,1\n0,1,2,1,1\n", "model_no_displacement", "no plane"),
        ("m.csv", HEAD + ROWS + "1,2\n", "model_unreadable", "row 5"),
        ("m.csv", HEAD, "model_unreadable", "0 rows"),
        ("m.csv", "", "model_unreadable", "no row of titles"),
        ("m.vtu", "<VTKFile", "model_unreadable", "no XML"),
        ("m.vtu", '<VTKFile type="PolyData"><PolyData/></VTKFile>', "model_unreadable", "PolyData"),
        ("m.vtu", '<!DOCTYPE a [<!ENTITY b "c">]><VTKFile>&b;</VTKFile>', "model_unreadable", "no XML"),
        ("m.xdmf", "<Xdmf><Domain/></Xdmf>", "model_unreadable", "no grid"),
        ("m.stl", "solid", "model_unreadable", "ends in none"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(
    name: str, content: str, code: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(StereorigError) as raised:
        read_model(tmp_path / name)
    assert raised.value.code == code
    assert said in raised.value.cause
    assert raised.value.remedy


def test_a_file_cut_short_anywhere_is_refused(surface: ModelSurface, tmp_path: Path) -> None:
    whole = write_model(tmp_path / "m.vtu", surface).read_bytes()
    for share in np.linspace(0.02, 0.99, 25):
        (tmp_path / "cut.vtu").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FileFormatError):
            read_model(tmp_path / "cut.vtu", unit="mm")


def test_changed_bytes_are_refused_or_read_never_a_crash(surface: ModelSurface, tmp_path: Path) -> None:
    whole = bytearray(write_model(tmp_path / "m.vtu", surface).read_bytes())
    rng = np.random.default_rng(1)
    for _ in range(60):
        changed = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            changed[at] = int(rng.integers(32, 127))
        (tmp_path / "c.vtu").write_bytes(changed)
        with contextlib.suppress(StereorigError):  # any other error fails the test
            read_model(tmp_path / "c.vtu", unit="mm").surface(TOWARDS)


def test_a_block_that_swells_is_refused(tmp_path: Path) -> None:
    import base64
    import zlib

    bomb = zlib.compress(b"\0" * 50_000_000)
    head = np.array([1, 50_000_000, 0, len(bomb)], np.uint32).tobytes()
    text = (base64.b64encode(head) + base64.b64encode(bomb)).decode()
    (tmp_path / "m.vtu").write_text(
        '<VTKFile type="UnstructuredGrid" compressor="vtkZLibDataCompressor"><UnstructuredGrid><Piece '
        'NumberOfPoints="3" NumberOfCells="0"><Points><DataArray type="Float64" NumberOfComponents="3" '
        f'format="binary">{text}</DataArray></Points></Piece></UnstructuredGrid></VTKFile>'
    )
    with pytest.raises(FileFormatError, match="50000000 bytes where 72"):
        read_model(tmp_path / "m.vtu", unit="mm")


def test_an_unknown_displacement_names_those_that_there_are(surface: ModelSurface, tmp_path: Path) -> None:
    made = meshio.Mesh(
        surface.nodes_mm,
        [("triangle", surface.triangles)],
        {"velocity": surface.displacement_mm, "ux": surface.displacement_mm[:, 0]},
    )
    meshio.write(tmp_path / "m.vtu", made)
    with pytest.raises(StereorigError) as raised:
        read_model(tmp_path / "m.vtu", unit="mm")
    assert raised.value.code == "model_no_displacement"
    assert "velocity (3)" in raised.value.cause
    assert read_model(tmp_path / "m.vtu", unit="mm", displacement="velocity").displacement_name == "velocity"
