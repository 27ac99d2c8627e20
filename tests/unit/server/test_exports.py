"""Exports hold what the result files hold, as read by programs that are not ours; and say where it comes from."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import h5py
import meshio
import numpy as np
import pandas as pd
import pytest
import pyvista as pv
import scipy.io
import xarray as xr
from PIL import Image

from stereorig.core.errors import InputError, StereorigError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.cli.main import main
from stereorig.server.exports.matlab import matlab_name
from stereorig.server.exports.request import ExportRequest
from stereorig.server.exports.run import export, export_packed
from stereorig.server.exports.source import find_source
from stereorig.server.formats.figures.options import FigureStyle
from stereorig.server.formats.version import software_version
from stereorig.server.results.steps import ExportSource
from tests.support.export_results import (
    CALIBRATION,
    COLS,
    CRACK_X_PX,
    FAILED,
    HOLE,
    MM_PER_PX,
    ROWS,
    SETTINGS,
    cylinder_normal,
    failed,
    write_results,
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exports") / "panel"
    write_results(folder)
    return folder


@pytest.fixture(scope="module")
def stored(results: Path) -> list[xr.Dataset]:
    """What the result files hold, by another reader."""
    return [xr.load_dataset(path, mask_and_scale=False) for path in sorted(results.glob("*.nc"))]


@pytest.fixture(scope="module")
def source(results: Path) -> ExportSource:
    return find_source(results)


def _made(source: ExportSource, out: Path, form: Any, **more: Any) -> list[Path]:
    return list(export(source, ExportRequest(form, **more), out))


# tables -----------------------------------------------------------------------------------------------------------


def test_a_table_holds_every_number_to_its_last_bit(
    source: ExportSource, stored: list[xr.Dataset], tmp_path: Path
) -> None:
    paths = _made(source, tmp_path, "csv")
    assert [p.name for p in paths] == [f"panel_step_{n:04d}_Stufe-{n}.csv" for n in range(3)]
    for path, held in zip(paths, stored, strict=True):
        table = pd.read_csv(path)
        assert len(table) == ROWS * COLS
        assert table.dtypes["w_mm" if "w_mm" in table else "z_mm"] == np.float64
        assert not {"iterations", "theta_rad", "normal_x", "exx_patch"} & set(table)  # internals
        for name, variable in held.variables.items():
            if variable.dims == ("row", "col") and name in table:
                read = table[name].to_numpy().astype(variable.dtype).reshape(ROWS, COLS)
                np.testing.assert_array_equal(read, variable.values, err_msg=str(name))
        named = table.set_index(["row", "col"]).loc[FAILED[0]]
        assert named["status_name"] == "low_correlation"
        assert np.isnan(named["x_mm"])
        assert named["x_px"] == 40 + 7 * FAILED[0][1]
    parts = pd.read_csv(paths[1])["zncc_cam1_ref__cam2_cur"].to_numpy().reshape(ROWS, COLS)
    np.testing.assert_array_equal(parts.astype("f4"), stored[1].zncc.values[..., 2])


def test_the_first_line_of_a_table_tells_unit_and_meaning_of_each_column(source: ExportSource, tmp_path: Path) -> None:
    (path,) = _made(source, tmp_path, "csv", steps=[1])
    table = pd.read_csv(path)
    assert list(table.columns)[-1] == "about"
    assert table.about.notna().sum() == 1
    about = json.loads(table.about[0])
    assert set(table) - {"status_name", "strain_status_name", "about"} == set(about["units"]) == set(about["meaning"])
    assert (about["units"]["u_mm"], about["units"]["exx"], about["units"]["x_px"]) == ("mm", "1", "pixel")
    # scripts that skip comments read the same
    pd.testing.assert_frame_equal(pd.read_csv(path, comment="#"), table)


def test_internals_are_in_a_table_that_asks_for_them(
    source: ExportSource, stored: list[xr.Dataset], tmp_path: Path
) -> None:
    (path,) = _made(source, tmp_path, "csv", steps=[1], variables=["normal_z", "iterations"])
    read = pd.read_csv(path)["normal_z"].to_numpy().reshape(ROWS, COLS)
    np.testing.assert_array_equal(read, stored[1].normal_z.values)


def test_chosen_variables_and_steps(source: ExportSource, tmp_path: Path) -> None:
    paths = _made(source, tmp_path, "csv", steps=[2], variables=["exx"])
    assert [p.name for p in paths] == ["panel_step_0002_Stufe-2.csv"]
    columns = list(pd.read_csv(paths[0]).columns)
    assert columns == ["row", "col", "x_px", "y_px", "x_mm", "y_mm", "z_mm", "status", "status_name", "exx", "about"]


# surfaces ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surfaces(source: ExportSource, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return _made(source, tmp_path_factory.mktemp("vtu"), "vtu")


def test_meshio_reads_the_surface_and_all_that_lies_on_it(surfaces: list[Path], stored: list[xr.Dataset]) -> None:
    held = stored[2]
    mesh = meshio.read(surfaces[2])
    ok = np.isin(held.status.values, (0, 10))
    xyz = np.stack([held[n].values[ok] for n in ("x_mm", "y_mm", "z_mm")], axis=1)
    np.testing.assert_array_equal(mesh.points, xyz)
    uvw = np.stack([held[n].values[ok] for n in ("u_mm", "v_mm", "w_mm")], axis=1)
    np.testing.assert_array_equal(mesh.point_data["displacement"], uvw)
    for name in ("exx", "sigma_w_mm", "status", "e1", "normal_z", "x_px"):
        np.testing.assert_array_equal(mesh.point_data[name], held[name].values[ok])
    assert np.isfinite(mesh.points).all()
    # every point is shown: by a triangle or, alone, as a vertex
    shown = np.unique(np.concatenate([c.data.ravel() for c in mesh.cells]))
    np.testing.assert_array_equal(shown, np.arange(len(xyz)))


def test_vtk_warps_the_surface_to_where_it_is(surfaces: list[Path], stored: list[xr.Dataset]) -> None:
    grid = pv.read(surfaces[2])
    warped = grid.warp_by_vector("displacement", factor=1.0)
    held = stored[2]
    ok = np.isin(held.status.values, (0, 10))
    now = np.stack([(held[a] + held[b]).values[ok] for a, b in (("x_mm", "u_mm"), ("y_mm", "v_mm"), ("z_mm", "w_mm"))])
    np.testing.assert_allclose(warped.points, now.T, atol=1e-6)
    assert grid.field_data["TimeValue"][0] == 2.0
    assert grid.field_data["load_n"][0] == 251.0


def test_no_triangle_reaches_over_crack_hole_or_failed_point(surfaces: list[Path]) -> None:
    mesh = meshio.read(surfaces[1])
    three = mesh.cells_dict["triangle"]
    x, y = mesh.point_data["x_px"][three], mesh.point_data["y_px"][three]
    assert np.ptp(x, axis=1).max() == np.ptp(y, axis=1).max() == 7.0  # neighbours alone
    above = y.min(axis=1) < 130.0
    assert not (above & (x.min(axis=1) < CRACK_X_PX) & (x.max(axis=1) > CRACK_X_PX)).any()
    # below its tip it does: the crack ends there
    assert ((y.min(axis=1) > 130.0) & (x.min(axis=1) < CRACK_X_PX) & (x.max(axis=1) > CRACK_X_PX)).any()
    hole = np.array(HOLE)
    middle = x.mean(axis=1), y.mean(axis=1)
    assert not (
        (middle[0] > hole[:, 0].min())
        & (middle[0] < hole[:, 0].max())
        & (middle[1] > hole[:, 1].min())
        & (middle[1] < hole[:, 1].max())
    ).any()
    # the pin hole lies in one triangle of its cell, which is left out; the other stays
    cell = (x.min(axis=1) <= 202.0) & (x.max(axis=1) >= 203.0) & (y.min(axis=1) <= 83.0) & (y.max(axis=1) >= 84.0)
    assert cell.sum() == 1
    # two triangles a cell of four good points, one a cell of three, less those that the cuts took
    ok = ~failed()
    corners = ok[:-1, :-1] * 1 + ok[:-1, 1:] + ok[1:, :-1] + ok[1:, 1:]
    left = 2 * (corners == 4).sum() + (corners == 3).sum() - len(three)
    cracked = sum(1 for r in range(ROWS - 1) if 60 + 7 * r < 130)  # cells that the crack parts, two triangles each
    assert 2 * cracked <= left - 1 <= 2 * cracked + 30  # and those whose sides meet the hole's border


def test_areas_and_normals_are_those_of_the_cylinder(surfaces: list[Path]) -> None:
    mesh = pv.read(surfaces[1])
    triangles = mesh.extract_cells(np.flatnonzero(mesh.celltypes == pv.CellType.TRIANGLE))
    sized = triangles.compute_cell_sizes(length=False, volume=False)
    # the arc is as long as the image shows it: half a cell of 7 px; a chord is shorter by (s / R)^2 / 24
    np.testing.assert_allclose(sized["Area"], 0.5 * (7 * MM_PER_PX) ** 2, rtol=5e-6)
    normals = triangles.extract_surface(algorithm="dataset_surface").compute_normals(
        cell_normals=True, point_normals=False, consistent_normals=False, auto_orient_normals=False
    )
    # as the points' own, away from the cameras: not one is turned the other way
    true = cylinder_normal(normals.cell_centers().points[:, 0].astype(float))
    angle = np.arccos(np.clip(np.sum(normals["Normals"] * true, axis=1), -1, 1))
    assert angle.max() < 7 * MM_PER_PX / 20.0 / 2 + 1e-3


def test_the_series_plays_in_time_and_begins_at_rest(surfaces: list[Path]) -> None:
    series = surfaces[-1]
    assert series.name == "panel.pvd"
    reader = pv.get_reader(series)
    assert list(reader.time_values) == [0.0, 1.0, 2.0]
    for n in range(3):
        reader.set_active_time_value(float(n))
        block = reader.read()[0]
        w = block.point_data["displacement"][:, 2]
        assert np.ptp(w) < 1e-12 if n == 0 else True
        assert abs(w.mean() + 0.05 * n) < 1e-9


def test_a_mask_parts_the_surface(results: Path, source: ExportSource, tmp_path: Path) -> None:
    mask = np.full((300, 300), 255, np.uint8)
    mask[:, 66] = 0  # between the columns at 61 and 68 px
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = ExportSource(source.files, "m", mask=tmp_path / "mask.png")
    mesh = meshio.read(_made(masked, tmp_path, "vtu", steps=[1])[0])
    x = mesh.point_data["x_px"][mesh.cells_dict["triangle"]]
    assert not ((x.min(axis=1) < 66) & (x.max(axis=1) > 66)).any()
    assert (x.max(axis=1) == 61).any()
    assert (x.min(axis=1) == 68).any()


# MATLAB and HDF5 --------------------------------------------------------------------------------------------------


def test_scipy_opens_the_matlab_file(source: ExportSource, stored: list[xr.Dataset], tmp_path: Path) -> None:
    (path,) = _made(source, tmp_path, "mat")
    read = scipy.io.loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(read["step"], [0, 1, 2])
    assert read["w_mm"].shape == (ROWS, COLS, 3)
    assert np.isnan(read["w_mm"][..., 0]).all()  # a shape has no displacement; it is not zero
    about = read["about"]
    for n, held in enumerate(stored):
        for name, variable in held.variables.items():
            if variable.dims[:2] == ("row", "col"):
                values = read[name]
                assert values.dtype == np.float64
                if name not in ("x_px", "y_px"):
                    values = values[:, :, n, ...][(..., *(slice(0, k) for k in variable.shape[2:]))]
                if name == "covariance" and n:  # a matrix here, its upper triangle row by row there
                    i, j = np.triu_indices(6)
                    np.testing.assert_array_equal(values, np.swapaxes(values, -1, -2))
                    values = values[..., i, j]
                wanted = np.squeeze(variable.values.astype(float))
                np.testing.assert_array_equal(np.squeeze(values), wanted, err_msg=str(name))
                assert about["units"][name] == variable.attrs["units"]
        assert read["label"][n] == f"Stufe {n} µ"
        assert read["load_n"][n] == 125.5 * n if n else np.isnan(read["load_n"][n])
        assert json.loads(read["provenance"][n])["step"] == n
    for names in (about, (name for name in read if not name.startswith("__"))):
        assert all(re.fullmatch(r"[A-Za-z]\w{0,62}", field) for field in names)


def test_names_that_matlab_does_not_take_are_changed() -> None:
    assert matlab_name("u_mm") == "u_mm"
    assert matlab_name("end") == "v_end"
    assert matlab_name("_private") == "v__private"
    assert matlab_name("1st strain") == "v_1st_strain"
    assert matlab_name("µm") == "v__m"
    assert len(matlab_name("x" * 100)) == 63


def test_h5py_opens_the_stack(source: ExportSource, stored: list[xr.Dataset], tmp_path: Path) -> None:
    (path,) = _made(source, tmp_path, "h5")
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["step"][...], [0, 1, 2])
        np.testing.assert_array_equal(file["load_n"][...], [np.nan, 125.5, 251.0])
        assert file["u_mm"].shape == (3, ROWS, COLS)
        assert np.isnan(file["u_mm"][0]).all()  # a shape has no displacement; it is not zero
        assert (file["strain_status"][0] == -1).all()
        np.testing.assert_array_equal(file["x_px"][...], stored[0].x_px.values)
        for n, held in enumerate(stored):
            for name, variable in held.variables.items():
                if variable.dims[:2] == ("row", "col") and name not in ("x_px", "y_px"):
                    part = tuple(slice(0, k) for k in variable.shape[2:])
                    values = variable.values
                    if name == "covariance" and n:  # a matrix here, its upper triangle row by row there
                        i, j = np.triu_indices(6)
                        np.testing.assert_array_equal(file[name][n][..., i, j], values)
                        np.testing.assert_array_equal(file[name][n][..., j, i], values)
                        continue
                    np.testing.assert_array_equal(file[name][(n, slice(None), slice(None), *part)], values)
        assert file["u_mm"].attrs["units"] == b"mm"
        assert json.loads(file.attrs["settings"]) == SETTINGS
    with xr.open_dataset(path) as opened:
        assert opened.w_mm.dims == ("step", "row", "col")
        assert opened.label.values[2] == "Stufe 2 µ"


def test_netcdf_is_given_as_stored(source: ExportSource, tmp_path: Path) -> None:
    paths = _made(source, tmp_path, "nc")
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in source.files]


# figures and films ------------------------------------------------------------------------------------------------


def test_a_figure_has_the_scales_colours_units_and_origin(source: ExportSource, tmp_path: Path) -> None:
    (path,) = _made(source, tmp_path, "png", steps=[2], variables=["u_mm"], style=FigureStyle(width_px=700))
    with Image.open(path) as opened:
        assert opened.width == 700
        assert json.loads(opened.text["Provenance"])["settings"] == SETTINGS  # type: ignore[attr-defined]
        assert opened.text["Units"] == "mm"  # type: ignore[attr-defined]
        pixels = np.asarray(opened.convert("RGB")).reshape(-1, 3)
    # viridis' ends, from its definition: both ends of the scale are drawn
    for end in ((68, 1, 84), (253, 231, 37)):
        assert (np.abs(pixels.astype(int) - end).max(axis=1) <= 2).sum() > 50


def test_an_svg_says_in_words_what_it_shows(source: ExportSource, tmp_path: Path) -> None:
    (path,) = _made(source, tmp_path, "svg", steps=[2], variables=["exx"])
    text = path.read_text(encoding="utf-8")
    for words in (
        "step 2 (Stufe 2 µ), load 251 N",
        "Green-Lagrange strain",
        "µm/m",  # as the page shows strain
        "subset 21 px",
        CALIBRATION[:12],
        "stereorig 9.8.7",
        "away from the cameras",
    ):
        assert words in text, words


def test_limits_percentiles_and_states(source: ExportSource, tmp_path: Path) -> None:
    given = FigureStyle(limits=(-0.2, 0.3))
    (path,) = _made(source, tmp_path, "svg", steps=[1], variables=["u_mm"], style=given)
    ticks = {float(t.replace("−", "-")) for t in re.findall(r">(−?0\.\d+)</text>", path.read_text(encoding="utf-8"))}
    assert max(ticks) == 0.3
    assert min(ticks) == -0.2
    (states,) = _made(source, tmp_path, "svg", steps=[1], variables=["status"])
    assert "low_correlation" in states.read_text(encoding="utf-8")
    for bad in (
        {"limits": (1.0, 1.0)},
        {"percentiles": (50.0, 20.0)},
        {"colours": "jet2"},
        {"width_px": 3},
        {"limits": (float("nan"), 1.0)},
        {"opacity": 0.0},
    ):
        with pytest.raises(InputError) as caught:
            FigureStyle(**bad)  # type: ignore[arg-type]
        assert caught.value.code == "figure_style_invalid"


def test_a_map_lies_over_the_image_where_its_points_are(source: ExportSource, tmp_path: Path) -> None:
    image = np.full((260, 300), 60, np.uint8)
    image[:, 150:] = 190
    cv2.imwrite(str(tmp_path / "cam1.tif"), image)
    over = ExportSource(source.files, "o", image=tmp_path / "cam1.tif")
    style = FigureStyle(width_px=1000, opacity=1.0)
    (path,) = _made(over, tmp_path, "png", steps=[1], variables=["u_mm"], over_image=True, style=style)
    drawn = np.asarray(Image.open(path).convert("RGB")).astype(int)
    grey = np.ptp(drawn, axis=2) <= 6
    dark, light = grey & (np.abs(drawn[..., 0] - 60) < 50), grey & (drawn[..., 0] > 150) & (drawn[..., 0] < 250)
    assert dark.any()
    assert light.any()
    colour = ~grey[:, : int(0.84 * 1000)]
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(colour.astype(np.uint8))
    rows, cols = np.nonzero(labels == 1 + np.argmax(boxes[1:, cv2.CC_STAT_AREA]))  # the axes' drawing is less
    # the map's outline in the picture, as a share of the image: x 36.5 to 253.5 of 300 px, y 56.5 to 224.5 of 260
    assert abs((np.ptp(cols) + 1) / (np.ptp(rows) + 1) - 217 / 168) < 0.03
    with pytest.raises(NotFoundError) as caught:
        _made(source, tmp_path, "png", over_image=True)
    assert caught.value.code == "image_missing"


def test_films_have_a_frame_a_step_on_one_scale(source: ExportSource, tmp_path: Path) -> None:
    style = FigureStyle(width_px=500)
    (gif,) = _made(source, tmp_path, "gif", style=style, fps=4.0)
    with Image.open(gif) as opened:
        assert opened.n_frames == 2  # type: ignore[attr-defined]  # the reference has no displacement
        assert opened.info["duration"] == 250
        assert json.loads(opened.info["comment"])["settings"] == SETTINGS
        seen = []
        for k in range(2):
            opened.seek(k)
            seen.append(np.asarray(opened.convert("RGB")).astype(int)[150:250, 100:350].mean(axis=(0, 1)))
    # w is uniform, -0.05 and -0.10 mm: the first is at the scale's upper end, the second at its lower one
    assert np.abs(seen[0] - (253, 231, 37)).max() < 60
    assert np.abs(seen[1] - (68, 1, 84)).max() < 60
    (mp4,) = _made(source, tmp_path, "mp4", style=style, fps=4.0)
    film = cv2.VideoCapture(str(mp4))
    frames = []
    while (got := film.read())[0]:
        frames.append(got[1])
    assert len(frames) == 2
    assert film.get(cv2.CAP_PROP_FPS) == 4.0
    for frame, colour in zip(frames, seen, strict=True):
        np.testing.assert_allclose(frame[150:250, 100:350, ::-1].mean(axis=(0, 1)), colour, atol=8)
    with pytest.raises(InputError):
        _made(source, tmp_path, "gif", fps=0.0)


# provenance, requests that cannot be met, command line ---------------------------------------------------------------


def _provenance(path: Path) -> dict[str, Any]:
    if path.suffix == ".csv":
        return dict(json.loads(pd.read_csv(path).about[0]))
    if path.suffix == ".vtu":
        bytes_ = pv.read(path).field_data["provenance_json_utf8"]
        found: dict[str, Any] = json.loads(bytes(bytes_).decode())
        comment = re.search(r"<!-- (.*?) -->", path.read_text(encoding="utf-8"), re.DOTALL)
        assert comment is not None
        assert json.loads(comment[1]) == found
        assert found["units"]["displacement"] == "mm"
        return found
    if path.suffix == ".mat":
        about = scipy.io.loadmat(path, simplify_cells=True)["about"]
        return {**about, "settings": json.loads(about["settings"])}
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return dict(json.loads(file["provenance"][0]))
    if path.suffix == ".png":
        with Image.open(path) as opened:
            return dict(json.loads(opened.text["Provenance"]))  # type: ignore[attr-defined]
    if path.suffix == ".gif":
        with Image.open(path) as opened:
            return dict(json.loads(opened.info["comment"]))
    text = path.read_text(encoding="utf-8")
    description = re.search(r"<dc:description>(.*?)</dc:description>", text, re.DOTALL)
    assert description is not None
    return dict(json.loads(json.loads(description[1].replace("&quot;", '"').replace("&amp;", "&"))["Provenance"]))


@pytest.mark.parametrize("form", ["csv", "vtu", "mat", "h5", "png", "svg", "gif"])
def test_every_export_says_frame_settings_calibration_and_version(
    source: ExportSource, tmp_path: Path, form: str
) -> None:
    provenance = _provenance(_made(source, tmp_path, form, steps=[1])[0])
    assert provenance["settings"] == SETTINGS
    assert provenance["calibration_sha256"] == CALIBRATION
    assert provenance["frame"].startswith("sys: X_sys, Y_sys in the calibration target's plane")
    assert provenance["measured_with"] == "stereorig 9.8.7"
    assert provenance["software"] == f"stereorig {software_version()}"
    assert provenance["length_unit"] == "mm"


def test_what_is_not_there_is_refused_by_name(source: ExportSource, tmp_path: Path) -> None:
    for more, code in (
        ({"steps": [7]}, "step_missing"),
        ({"variables": ["nix"]}, "field_missing"),
        ({"variables": ["covariance"]}, "field_missing"),
    ):
        with pytest.raises(StereorigError) as caught:
            _made(source, tmp_path, "png", **more)
        assert caught.value.code == code
    with pytest.raises(StereorigError) as caught:
        _made(ExportSource([], "none"), tmp_path, "csv")
    assert caught.value.code == "no_results"
    assert not list(tmp_path.iterdir())


def test_several_files_are_packed_and_one_is_not(source: ExportSource, tmp_path: Path) -> None:
    import zipfile

    packed = export_packed(source, ExportRequest("csv"), tmp_path)
    with zipfile.ZipFile(packed) as archive:
        assert archive.namelist() == [f"panel_step_{n:04d}_Stufe-{n}.csv" for n in range(3)]
        assert archive.testzip() is None
    assert [p.name for p in tmp_path.iterdir()] == ["panel_csv.zip"]
    assert export_packed(source, ExportRequest("mat"), tmp_path).name == "panel.mat"


def test_the_command_line(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "folder"
    assert (
        main(["export", str(results), "--format", "csv", "--out", str(out), "--step", "0-1", "--variable", "z_mm"]) == 0
    )
    assert sorted(p.name for p in out.iterdir()) == ["panel_step_0000_Stufe-0.csv", "panel_step_0001_Stufe-1.csv"]
    assert "written: 2 files" in capsys.readouterr().out
    for arguments, code in (
        (["--step", "x"], "step_invalid"),
        (["--limits", "2"], "figure_style_invalid"),
        (["--limits=2,1"], "figure_style_invalid"),
        (["--analysis", "a1"], "option_conflict"),
        (["--step", "9"], "step_missing"),
    ):
        assert main(["export", str(results), "--format", "png", "--out", str(out), *arguments]) == 1
        assert code in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--format", "csv", "--out", str(out)]) == 1
    assert "results_missing" in capsys.readouterr().err


def test_a_tests_folder_and_its_analyses(tmp_path: Path) -> None:
    test = tmp_path / "t000001-abcdef"
    (test / "steps" / "0000").mkdir(parents=True)
    cv2.imwrite(str(test / "steps" / "0000" / "cam1.tif"), np.zeros((9, 9), np.uint8))
    (test / "test.json").write_text(json.dumps({"id": test.name, "name": "Panel 7", "calibration_id": "c000002-1"}))
    write_results(test / "analyses" / "a000001-000001", 1)
    found = find_source(test)
    assert found.title == "Panel 7"
    assert found.image == test / "steps" / "0000" / "cam1.tif"
    assert (found.about["calibration_id"], found.about["analysis_id"]) == ("c000002-1", "a000001-000001")
    assert found.stale_reasons  # its images are not those that the result was made from
    write_results(test / "analyses" / "a000002-000002", 1)
    with pytest.raises(InputError) as caught:
        find_source(test)
    assert caught.value.code == "analysis_ambiguous"
    assert find_source(test, "a000002-000002").name == "Panel-7_a000002-000002"
    (test / "analyses" / "a000002-000002" / "analysis.json").write_text('{"label": "fine, 33 px"}')
    assert find_source(test, "a000002-000002").name == "Panel-7_fine-33-px"
    (test / "test.json").write_text('{"name": "\u8bd5\u6837"}')  # a name in another script: the id
    assert find_source(test, "a000002-000002").name == f"{test.name}_fine-33-px"
    with pytest.raises(InputError):
        find_source(test, "a000003-000003")
