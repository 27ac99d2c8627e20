"""Finite element results as viewers and other programs write them: tables of every dialect, cells of every family."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
import pytest
from vtkmodules.vtkCommonCore import vtkDoubleArray, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.cell.cell import Cell
from stereorig.server.cell.models import model
from stereorig.server.formats.models.read import ModelFile, read_model

TOWARDS = np.array([0.0, 0.0, 1.0])
X, Y = (v.ravel() for v in np.meshgrid(np.linspace(-2.0, 2.0, 5), np.linspace(-1.0, 1.0, 4)))
POINTS = np.column_stack([X, Y, 0.1 * X * Y])
MOVED = np.column_stack([0.01 * X, -0.003 * Y, 0.002 * X * X])
OTHER = np.column_stack([X + 7.0, Y, X])


def table(path: Path, titles: str, *columns: np.ndarray, mark: str = ",", decimal: str = ".") -> Path:
    rows = [mark.join(f"{v:.9g}".replace(".", decimal) for v in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([titles, *rows]) + "\n", encoding="utf-8")
    return path


def is_the_model(read: ModelFile, *, plane: bool = False) -> None:
    flat = np.array([1.0, 1.0, 0.0]) if plane else np.ones(3)
    np.testing.assert_allclose(read.nodes_mm, POINTS * flat, atol=1e-9)
    np.testing.assert_allclose(read.displacement_mm, MOVED * flat, atol=1e-9)
    assert read.plane == plane


@pytest.mark.parametrize(
    ("titles", "order"),
    [
        ('"U:0","U:1","U:2","U:Magnitude","Points:0","Points:1","Points:2"', "um p"),
        ('"Point ID","U_0","U_1","U_2","Points_0","Points_1","Points_2","Points_Magnitude"', "iu pm"),
        ("Points_X,Points_Y,Points_Z,displacement_X,displacement_Y,displacement_Z,stress_0,stress_1", "pu s"),
        ("Node Number,X Location (mm),Y Location (mm),Z Location (mm),X Deformation (mm),Y Deformation (mm),"
         "Z Deformation (mm),Total Deformation (mm)", "ip um"),
        ("Node Label,COORD.COOR1,COORD.COOR2,COORD.COOR3,U.U1,U.U2,U.U3,U.Magnitude", "ip um"),
        ("x [mm], y [mm], z [mm], ux [mm], uy [mm], uz [mm]", "pu"),
        ('"X","Y","Z","Displacement field, X component (mm)","Displacement field, Y component (mm)",'
         '"Displacement field, Z component (mm)"', "pu"),
        ("node,x0,y0,z0,u1,u2,u3,ur1,ur2,ur3,rf1", "ip us m"),
        ("Coord 1,Coord 2,Coord 3,Nodal Displacement 1,Nodal Displacement 2,Nodal Displacement 3", "pu"),
        ("DX,DY,DZ,X,Y,Z,V:0,V:1,V:2", "up o"),
    ],
)  # fmt: skip
def test_the_titles_of_every_program_name_the_same_model(titles: str, order: str, tmp_path: Path) -> None:
    columns = {"p": POINTS, "u": MOVED, "o": OTHER, "i": np.arange(len(X)), "m": np.linalg.norm(MOVED, axis=1)}
    columns["s"] = OTHER[:, :3] if "ur1" in titles else OTHER[:, :2]
    held = [columns[one] for one in order.replace(" ", "")]
    for mark in (",", ";", "\t"):
        if mark == "," or '"' not in titles:
            written = titles.replace(", ", ",").replace(",", mark) if '"' not in titles else titles
            path = table(tmp_path / "m.csv", written, *held, mark=mark, decimal="," if mark == ";" else ".")
            is_the_model(read_model(path, unit=None if "(mm)" in titles and "Location" in titles else "mm"))


@pytest.mark.parametrize("mark", ["#", "%"])
def test_titles_and_remarks_may_be_comments_and_a_line_state_the_unit_of_length(mark: str, tmp_path: Path) -> None:
    head = "\n".join(
        f"{mark} {line}" for line in ("Model: a.mph", "Nodes: 20", "Description: u, v, w", "Length unit: mm")
    )
    for titles in (
        "x                  y           z         u (mm)        v (mm)     w (mm)",
        "x y z u (mm) v (mm) w (mm)",
    ):
        path = table(tmp_path / "m.txt", f"{head}\n{mark} {titles}", POINTS, MOVED, mark="     ")
        is_the_model(read_model(path))
    path = table(
        tmp_path / "m.csv", f"{head.replace(': mm', ',m')}\n{mark} X,Y,Z,u (mm),v (mm),w (mm)", 1e-3 * POINTS, MOVED
    )
    is_the_model(read_model(path))


@pytest.mark.parametrize(
    ("titles", "columns"),
    [
        ("x_mm,y_mm,u_mm,v_mm", [POINTS[:, :2], MOVED[:, :2]]),
        ("U:0,U:1,Points:0,Points:1,Points:2", [MOVED[:, :2], POINTS[:, :2], 0 * X]),
        ("COOR1,COOR2,U1,U2", [POINTS[:, :2], MOVED[:, :2]]),
    ],
)
def test_two_displacements_are_those_of_a_plane_model(titles: str, columns: list[np.ndarray], tmp_path: Path) -> None:
    is_the_model(read_model(table(tmp_path / "m.csv", titles, *columns), unit="mm"), plane=True)


def test_of_two_vectors_that_may_be_the_displacement_one_is_asked_for(tmp_path: Path) -> None:
    titles = "x,y,z,U:0,U:1,U:2,displacement:0,displacement:1,displacement:2,velocity:0,velocity:1,velocity:2"
    path = table(tmp_path / "m.csv", titles, POINTS, MOVED, OTHER, OTHER)
    with pytest.raises(StereorigError) as raised:
        read_model(path, unit="mm")
    assert raised.value.code == "model_displacement_unclear"
    assert "displacement, U" in raised.value.cause
    assert "--displacement" in raised.value.remedy
    for name in ("U", "u", "U:0,U:1,U:2", "u:0, u:1, u:2"):
        is_the_model(read_model(path, unit="mm", displacement=name))
    assert read_model(path, unit="mm", displacement="velocity").displacement_name == "velocity"
    for name in ("acceleration", "U:0,U:1,U:7"):
        with pytest.raises(StereorigError, match=r"U \(3\), displacement \(3\), velocity \(3\)") as raised:
            read_model(path, unit="mm", displacement=name)
        assert raised.value.code == "model_no_displacement"


def test_of_two_arrays_of_a_mesh_one_is_asked_for_unless_they_agree(tmp_path: Path) -> None:
    cells = [("triangle", np.array([[0, 1, 5], [1, 6, 5]]))]
    for other, agree in ((MOVED, True), (OTHER, False)):
        meshio.write(tmp_path / "m.vtu", meshio.Mesh(POINTS, cells, {"displacement": MOVED, "U": other}))
        if agree:
            assert read_model(tmp_path / "m.vtu", unit="mm").displacement_name == "displacement"
        else:
            with pytest.raises(StereorigError) as raised:
                read_model(tmp_path / "m.vtu", unit="mm")
            assert raised.value.code == "model_displacement_unclear"
    # a vector that was padded with zeros, as FEniCS does, can be given as a plane model's
    flat = POINTS * [1.0, 1.0, 0.0]
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(flat, cells, {"u": MOVED * [1.0, 1.0, 0.0]}))
    assert not read_model(tmp_path / "m.vtu", unit="mm").plane
    is_the_model(read_model(tmp_path / "m.vtu", unit="mm", displacement="u:0,u:1"), plane=True)
    is_the_model(read_model(tmp_path / "m.vtu", unit="mm", displacement="u_x,u_y"), plane=True)


# cells -------------------------------------------------------------------------------------------------------------

CORNERS = [(0, 0), (1, 0), (1, 1), (0, 1)]
QUAD = [(*p, 0) for p in CORNERS]
MIDDLES = [(0.5, 0, 0), (1, 0.5, 0), (0.5, 1, 0), (0, 0.5, 0), (0.5, 0.5, 0)]
BOX = [(*p, z) for z in (-1, 0) for p in CORNERS]
TRIANGLE, TRIANGLE_MIDDLES = [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0.5, 0, 0), (0.5, 0.5, 0), (0, 0.5, 0)]
ROWS = [(x, y, z) for z in (-1, 0) for y in (0, 1) for x in (0, 1)]
TET = [(0, 0, 0), (0, 1, 0), (1, 0, 0), (0.2, 0.2, -1)]
ARROW = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0)]  # concave at its last corner
MANY = [(k / 30.0, 0.3 + 0.01 * (k % 4), -0.5) for k in range(30)]  # other nodes of a higher order


@pytest.fixture(scope="module")
def cell() -> Iterator[Cell]:
    made = Cell()
    yield made
    made.close()


@pytest.mark.parametrize(
    ("kind", "nodes", "area", "corners_only"),
    [
        (69, TRIANGLE, 0.5, 0), (70, QUAD, 1.0, 0), (71, TET, 0.5, 0), (72, BOX, 1.0, 0),
        (73, [BOX[k] for k in (4, 6, 5, 0, 2, 1)], 0.5, 0), (74, [*QUAD[::-1], (0.5, 0.5, -1)], 1.0, 0),
        (69, TRIANGLE + TRIANGLE_MIDDLES, 0.5, 0), (70, QUAD + MIDDLES, 1.0, 0),
        (34, [*TRIANGLE, *TRIANGLE_MIDDLES, (0.3, 0.3, 0)], 0.5, 1), (70, QUAD + MANY[:12], 1.0, 1),
        (72, BOX + MANY[:19], 1.0, 1), (29, BOX + MANY[:19], 1.0, 1), (77, QUAD + MIDDLES, 1.0, 1),
        (7, [(0, 0, 0), (2, 0, 0), (3, 1, 0), (2, 2, 0), (0, 2, 0)], 5.0, 0), (7, ARROW, 6.0, 0),
        (7, ARROW[1:] + ARROW[:1], 6.0, 0), (36, [*QUAD, *MIDDLES[:4]], 1.0, 1),
        (8, [QUAD[k] for k in (0, 1, 3, 2)], 1.0, 0), (11, ROWS, 1.0, 0),
        (6, [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (2, 0, 0)], 1.5, 0), (22, TRIANGLE + TRIANGLE_MIDDLES, 0.5, 0),
    ],
)  # fmt: skip
def test_cells_of_every_family_are_the_surface_that_they_span(
    kind: int, nodes: list[tuple[float, ...]], area: float, corners_only: int, tmp_path: Path, cell: Cell
) -> None:
    points, grid = vtkPoints(), vtkUnstructuredGrid()
    moved = vtkDoubleArray()
    moved.SetName("displacement")
    moved.SetNumberOfComponents(3)
    for x, y, z in nodes:
        points.InsertNextPoint(x, y, z)
        moved.InsertNextTuple3(0.1 * x, 0.2 * y, x + y)
    grid.SetPoints(points)
    grid.GetPointData().AddArray(moved)
    grid.InsertNextCell(kind, len(nodes), range(len(nodes)))
    grid.InsertNextCell(3, 2, [0, 1])  # a line beside it is no part of a surface
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(tmp_path / "m.vtu"))
    writer.SetInputData(grid)
    assert writer.Write()
    read = read_model(tmp_path / "m.vtu", unit="mm")
    assert read.mesh.corners_only == corners_only
    surface = read.surface(TOWARDS)
    seen = surface.area_mm2[np.abs(surface.normals[:, 2]) > 0.999].sum()  # of solids the face that looks up
    assert seen == pytest.approx(area)
    at = np.array([[0.3, 0.1, 0.0]])
    np.testing.assert_allclose(surface.displacement_at(surface.feet(at))[0], [0.03, 0.02, 0.4], atol=1e-12)
    again = model(cell, {"m.vtu": tmp_path / "m.vtu"}, "m.vtu", {"unit": "mm"})
    assert again.mesh.corners_only == corners_only
    np.testing.assert_array_equal(again.surface(TOWARDS).triangles, surface.triangles)


def test_polygons_and_higher_orders_of_an_xdmf_are_read(tmp_path: Path) -> None:
    def xdmf(topology: str, numbers: str, nodes: list[tuple[float, ...]]) -> ModelFile:
        flat = " ".join(str(v) for node in nodes for v in node)
        item = f'<DataItem Dimensions="{len(nodes)} 3">{flat}</DataItem>'
        corners = f'<DataItem Dimensions="{len(numbers.split())}">{numbers}</DataItem>'
        (tmp_path / "m.xdmf").write_text(
            f'<Xdmf><Domain><Grid><Topology {topology}>{corners}</Topology><Geometry GeometryType="XYZ">{item}'
            f'</Geometry><Attribute Name="u" AttributeType="Vector">{item}</Attribute></Grid></Domain></Xdmf>'
        )
        return read_model(tmp_path / "m.xdmf", unit="mm")

    five = [(0, 0, 0), (2, 0, 0), (3, 1, 0), (2, 2, 0), (0, 2, 0)]
    read = xdmf('TopologyType="Polygon" NodesPerElement="5"', "0 1 2 3 4", five)
    assert read.surface(TOWARDS).area_mm2.sum() == pytest.approx(5.0)
    read = xdmf('TopologyType="Mixed"', "2 2 0 1 3 4 0 1 3 4 4 1 2 3", five)  # a line, a polygon, a triangle
    assert read.surface(TOWARDS).area_mm2.sum() == pytest.approx(4.0 + 1.0)
    numbers = " ".join(map(str, range(27)))
    read = xdmf('TopologyType="Hexahedron_27"', numbers, BOX + MANY[:19])
    assert read.mesh.corners_only == 1
    assert read.surface(TOWARDS).area_mm2.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # 1,214 is 1214 here; quoted or not, a row alone would not show it
        ("x;y;z;u;v;w\n363;1,214;5;1.5;0.5;0.25\n364;1,215;6;1.5;0.5;0.25\n", "points and commas"),
        ("x,y,z,u,v,w\n1_214,2,3,1,2,3\n", "points and commas"),
        ("x,y,z,X,Y,Z,u,v,w\n1,2,3,4,5,6,7,8,9\n", "two columns 'x'"),
        ("x,y,z,u,v,w,u,v,w\n1,2,3,4,5,6,7,8,9\n", "two columns 'u'"),
    ],
)
def test_numbers_and_titles_of_two_meanings_are_refused(text: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read_model(Path("m.csv"), unit="mm", contents={"m.csv": text.encode()})
