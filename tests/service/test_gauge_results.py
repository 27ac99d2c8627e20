"""``stereorig gauge`` and the API over result files with a known motion: same numbers, refusals, missing values."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import netCDF4
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.cli.main import main
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.workflows.service import Service
from tests.support.gauge_field import SUBSET, make_field, pixel_noise, surface
from tests.support.service_rig import new_test

API = "/api/v1"
TURN = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix()
SHIFT = np.array([1.0, -2.0, 0.5])
STRAINS = (0.0, 0.01, 0.03)
A, B = (55.0, 75.0), (145.0, 75.0)
INPUTS = {"calibration": "aa", "reference_cam1": "bb", "reference_cam2": "cc"}
FAILED = np.zeros((14, 17), bool)
FAILED[10, 6:9] = True


def flat(x_px: Float, y_px: Float) -> Float:
    return surface(x_px, y_px) * [1.0, 1.0, 0.0] + [0.0, 0.0, 300.0]


def stretched(strain: float) -> Field:
    F = TURN @ np.diag([1.0 + strain, 1.0 - 0.3 * strain, 1.0])
    return make_field(lambda x: x @ F.T + SHIFT, shape=flat, failed=FAILED)


def write(folder: Path, n: int, field: Field, **change: Any) -> Path:
    extra = {"label": f"step, {n}", "load_n": repr(100.0 * n)}
    given = {"settings": {"subset_px": SUBSET}, "inputs": INPUTS, "software_version": "1", "step": n, "extra": extra}
    path = folder / f"step_{n:04d}.nc"
    write_field(path, field, Provenance(**{**given, **change}))
    return path


def fill(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write(folder, 0, make_field(None, shape=flat, failed=FAILED))
    for n, strain in enumerate(STRAINS[1:], 1):
        write(folder, n, stretched(strain))
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("gauge") / "results")


def gauge(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str, str]:
    try:
        rc = main(["gauge", *map(str, args)])
    except SystemExit as ended:
        rc = int(ended.code or 0)
    printed = capsys.readouterr()
    return rc, printed.out, printed.err


OPTIONS = (
    "--extensometer",
    "axial=55,75,145,75",
    "--point",
    "60,80",
    "--line",
    "50,130,140,130,10",
    "--area",
    "54,74,124,102",
    "--area",
    "tri=54,74,124,74,124,102",
    "--area",
    "all",
)
BODY: dict[str, Any] = {
    "extensometers": [{"name": "axial", "a_px": A, "b_px": B}],
    "points": [{"xy_px": [60, 80]}],
    "lines": [{"vertices_px": [[50, 130], [140, 130]], "count": 10}],
    "areas": [
        {"rectangle_px": [54, 74, 124, 102]},
        {"name": "tri", "polygon_px": [[54, 74], [124, 74], [124, 102]]},
        {},
    ],
}


def test_time_histories_of_a_known_stretch(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "gauges.json"
    rc, printed, err = gauge(capsys, results, *OPTIONS, "--out", out)
    assert (rc, err) == (0, "")
    assert "extensometer axial from (55, 75) to (145, 75) px" in printed
    document = json.loads(out.read_text())
    for path in results.glob("*.nc"):
        assert document["inputs_sha256"][path.name] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert [s["load_n"] for s in document["steps"]] == [0.0, 100.0, 200.0]
    assert [s["label"] for s in document["steps"]] == ["step, 0", "step, 1", "step, 2"]
    for step, strain in zip(document["steps"][1:], STRAINS[1:], strict=True):
        values = step["extensometers"][0]["values"]
        assert values["length0_mm"]["value"] == pytest.approx(0.02 * 90.0)
        assert values["elongation_mm"]["value"] == pytest.approx(0.02 * 90.0 * strain)
        assert values["strain"]["value"] == pytest.approx(strain)
        assert values["true_strain"]["value"] == pytest.approx(np.log1p(strain))
        assert values["strain"]["sigma"] > 0.0
        point = step["points"][0]["values"]
        assert point["x_mm"]["value"] == pytest.approx(0.02 * (60 - 200))
        assert point["z_mm"]["value"] == pytest.approx(300.0)
    shape = document["steps"][0]
    assert shape["extensometers"][0]["values"]["strain"]["value"] is None
    assert set(shape["points"][0]["values"]) == {"x_mm", "y_mm", "z_mm"}
    area = document["steps"][1]["areas"][2]
    assert (area["points"], area["valid"]) == (14 * 17, 14 * 17 - 3)
    line = document["steps"][1]["lines"][0]
    lost = [text != "" for text in line["missing"]]
    assert 0 < sum(lost) < 6  # the line runs along the failed points' row
    assert [v is None for v in line["values"]["u_mm"]["value"]] == lost
    assert set(line["missing"]) == {"", "low_correlation"}


def test_gauges_in_mm_read_what_those_in_pixels_do(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ends = ",".join(str(v) for xy in (A, B) for v in flat(*map(np.array, xy))[:2])
    position_text = ",".join(str(v) for v in flat(np.array(60.0), np.array(80.0))[:2])
    mm = ("--extensometer-mm", f"far={ends}", "--point-mm", position_text)
    rc, _, err = gauge(capsys, results, *OPTIONS, *mm, "--out", tmp_path / "g.json")
    assert (rc, err) == (0, "")
    for step in json.loads((tmp_path / "g.json").read_text())["steps"]:
        for kind in ("points", "extensometers"):
            px, by_mm = step[kind]
            for name, number in px["values"].items():
                for part in ("value", "sigma"):
                    truth = None if number[part] is None else pytest.approx(number[part], rel=1e-6, abs=1e-12)
                    assert by_mm["values"][name][part] == truth
    # the origin of the plane's frame lies in the middle of the points
    rc, _, _ = gauge(capsys, results, "--align", "plane", "--point-mm", "0.1,-0.2", "--out", tmp_path / "h.json")
    assert rc == 0
    values = json.loads((tmp_path / "h.json").read_text())["steps"][0]["points"][0]["values"]
    assert (values["x_mm"]["value"], values["y_mm"]["value"]) == pytest.approx((0.1, -0.2), abs=1e-9)


def test_csv_holds_the_same_numbers_as_json(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("csv", "json"):
        assert gauge(capsys, results, *OPTIONS, "--remove-rigid", "--out", tmp_path / f"g.{kind}")[0] == 0
    document = json.loads((tmp_path / "g.json").read_text())
    text = (tmp_path / "g.csv").read_text()
    comments = dict(line[2:].split(": ", 1) for line in text.splitlines() if line.startswith("# "))
    assert json.loads(comments["inputs_sha256"]) == document["inputs_sha256"]
    assert json.loads(comments["settings"]) == document["settings"]
    rows = list(csv.DictReader(io.StringIO("".join(x + "\n" for x in text.splitlines() if not x.startswith("# ")))))
    strain = [r for r in rows if r["gauge"] == "axial" and r["quantity"] == "strain" and r["step"] == "2"]
    assert len(strain) == 1
    assert float(strain[0]["value"]) == document["steps"][2]["extensometers"][0]["values"]["strain"]["value"]
    assert (strain[0]["label"], strain[0]["load_n"], strain[0]["units"]) == ("step, 2", "200.0", "1")
    of_shape = [r for r in rows if r["gauge"] == "axial" and r["quantity"] == "strain" and r["step"] == "0"]
    assert [(r["value"], r["missing"]) for r in of_shape] == [("", "no value")]  # a shape has no strain
    line = [r for r in rows if r["kind"] == "line" and r["quantity"] == "w_mm" and r["step"] == "1"]
    values = document["steps"][1]["lines"][0]["values"]["w_mm"]["value"]
    assert [float(r["value"]) if r["value"] else None for r in line] == values
    assert all(bool(r["missing"]) == (not r["value"]) for r in line)


def test_rigid_motion_and_frame_on_the_command_line(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, 0, make_field(None, shape=flat))
    moved = make_field(lambda x: x @ TURN.T + SHIFT, shape=flat)
    errors = pixel_noise(np.random.default_rng(5), moved, 1)[0]
    assert moved.uvw_mm is not None
    write(tmp_path, 1, replace(moved, xyz_mm=moved.xyz_mm + errors[..., :3], uvw_mm=moved.uvw_mm + errors[..., 3:]))
    rc, printed, err = gauge(
        capsys,
        tmp_path,
        "--align",
        "plane",
        "--x-direction",
        "0,1,0",
        "--remove-rigid",
        "--robust",
        "--area",
        "all",
        "--point",
        "60,80",
        "--out",
        tmp_path / "g.json",
    )
    assert (rc, err) == (0, "")
    assert "rigid motion taken out" in printed
    document = json.loads((tmp_path / "g.json").read_text())
    assert document["frame"].startswith("aligned by plane")
    # the new X is the old Y, Z stays, so that the new Y is the old -X
    assert document["alignment"]["rotation"] == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), abs=1e-9)
    step = document["steps"][1]
    turned = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ [0.02, -0.05, 0.1]
    for axis, truth in zip("xyz", turned, strict=True):
        number = step["rigid_motion"]["values"][f"rotation_{axis}_rad"]
        assert number["value"] == pytest.approx(truth, abs=5 * number["sigma"])
        assert number["sigma"] < 1e-3
    for name in ("u_mm", "v_mm", "w_mm"):
        assert step["areas"][0]["values"][name]["mean"] == pytest.approx(0.0, abs=1e-4)
        assert abs(step["points"][0]["values"][name]["value"]) < 5 * step["points"][0]["values"][name]["sigma"]
    alignment = "3-2-1:50,70,140,75,80,140,55,100,120,104,61,66"
    rc, _, err = gauge(capsys, results, "--align", alignment, "--point", "61,66", "--out", tmp_path / "h.json")
    assert (rc, err) == (0, "")
    point = json.loads((tmp_path / "h.json").read_text())["steps"][0]["points"][0]["values"]
    assert point["x_mm"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert point["z_mm"]["value"] == pytest.approx(0.0, abs=1e-9)


def test_any_scalar_variable_of_the_file_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path, 0, make_field(None, shape=flat))
    path = write(tmp_path, 1, stretched(0.01))
    with netCDF4.Dataset(path, "a") as data:
        for name, add in (("exx", 0.0), ("sigma_exx", 1.0)):
            data.createVariable(name, "f8", ("row", "col"))[...] = 1e-5 * data["x_px"][...] + add
            data[name].units = "1"
    rc, _, err = gauge(
        capsys,
        tmp_path,
        "--variable",
        "exx",
        "--variable",
        "stretch_11",
        "--line",
        "45,75,75,75,4",
        "--area",
        "all",
        "--out",
        tmp_path / "g.json",
    )
    assert (rc, err) == (0, "")
    shape, step = json.loads((tmp_path / "g.json").read_text())["steps"]
    assert shape["areas"][0]["values"] == {}
    assert step["lines"][0]["values"]["exx"]["value"] == pytest.approx(1e-5 * np.array([45, 55, 65, 75]))
    assert step["lines"][0]["values"]["exx"]["sigma"] == pytest.approx(1 + 1e-5 * np.array([45, 55, 65, 75]))
    assert step["areas"][0]["values"]["exx"]["mean_sigma"] is None
    rc, _, err = gauge(capsys, tmp_path, "--variable", "colour", "--area", "all")
    assert (rc, err.count("\n")) == (1, 1)
    assert err.startswith("stereorig: field_missing:")
    rc, _, err = gauge(capsys, tmp_path, "--variable", "zncc", "--area", "all")
    assert err.startswith("stereorig: field_not_scalar:")


def test_strain_of_the_result_file_is_read_at_gauges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = stretched(0.03)
    strain = surface_strain(field, StrainOptions(window=3), subset_px=SUBSET)
    path = tmp_path / "step_0001.nc"
    write_field(path, field, Provenance({"subset_px": SUBSET}, INPUTS, "1", step=1), strain)
    rc, _, err = gauge(
        capsys,
        tmp_path,
        "--point",
        "82,95",
        "--area",
        "all",
        "--variable",
        "exx",
        "--variable",
        "eyy",
        "--align",
        "plane",
        "--remove-rigid",
        "--out",
        tmp_path / "g.json",
    )
    assert (rc, err) == (0, "")
    (step,) = json.loads((tmp_path / "g.json").read_text())["steps"]
    for name, stretch in (("exx", 1.03), ("eyy", 1.0 - 0.3 * 0.03)):
        number = step["points"][0]["values"][name]
        assert number["value"] == pytest.approx(0.5 * (stretch**2 - 1.0), abs=1e-6)
        assert 0.0 < number["sigma"] < 0.02
        assert step["areas"][0]["values"][name]["mean"] == pytest.approx(0.5 * (stretch**2 - 1.0), abs=1e-6)
        # the mean of some thirty windows that do not overlap, and more
        assert 0.05 * number["sigma"] < step["areas"][0]["values"][name]["mean_sigma"] < 0.3 * number["sigma"]


@pytest.mark.fault(40)
@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--point", "10,10"), "gauge_outside"),
        (("--extensometer", "60,80,60,500"), "gauge_outside"),
        (("--line", "60,80,400,80"), "gauge_outside"),
        (("--area", "0,0,20,20"), "gauge_outside"),
        (("--extensometer", "60,80,60,80"), "gauge_unusable"),
        (("--extensometer", "60,80,60"), "gauge_unusable"),
        (("--point-mm", "99,0"), "gauge_outside"),
        (("--point", "here"), "gauge_unusable"),
        (("--point", "nan,5"), "gauge_unusable"),
        (("--point", "-1e9,5"), "gauge_unusable"),
        (("--line", "60,80,90,80,1"), "gauge_unusable"),
        (("--line", "60,80,90,80,2.5"), "gauge_unusable"),
        (("--area", "90,80,60,70"), "gauge_unusable"),
        (("--area", "90,80,60,70,1"), "gauge_unusable"),
        (("--point", "a=60,80", "--point", "a=70,80"), "gauge_unusable"),
        (("--align", "best"), "gauge_unusable"),
        (("--align", "3-2-1:1,2,3"), "gauge_unusable"),
        (("--align", "3-2-1:50,70,60,70,70,70,50,70,90,70,60,70"), "gauge_unusable"),
        (("--align", "plane", "--x-direction", "0,0,1"), "gauge_unusable"),
        (("--robust", "--point", "60,80"), "option_conflict"),
        (("--x-direction", "1,0,0", "--point", "60,80"), "option_conflict"),
        (("--point", "60,80", "--step", "7"), "step_missing"),
        (("--point", "60,80", "--out", "g.txt"), "output_unusable"),
        ((), "gauge_unusable"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(
    results: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], code: str
) -> None:
    rc, _, err = gauge(capsys, results, *options)
    assert rc == 1
    assert err.startswith(f"stereorig: {code}:"), err
    assert err.count("\n") == 1
    assert "Remedy:" in err


@pytest.mark.fault(42)
@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("calibration", {"inputs": {**INPUTS, "calibration": "zz"}}),
        ("reference", {"inputs": {**INPUTS, "reference_cam1": "zz"}}),
        ("subset", {"settings": {"subset_px": 33}}),
    ],
)
def test_files_of_different_measurements_are_not_mixed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, change: dict[str, Any]
) -> None:
    write(tmp_path, 0, make_field(None, shape=flat))
    write(tmp_path, 1, stretched(0.01), **change)
    _, _, err = gauge(capsys, tmp_path, "--point", "60,80")
    assert err.startswith("stereorig: steps_mixed:")
    assert what in err
    write(tmp_path, 1, make_field(lambda x: x, rows=9, shape=flat))
    assert "another points" in gauge(capsys, tmp_path, "--point", "60,80")[2]


def test_a_step_too_empty_for_its_rigid_motion_says_so_and_the_others_stand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, 1, stretched(0.01))
    write(tmp_path, 2, make_field(lambda x: x, shape=flat, failed=np.ones((14, 17), bool)))
    rc, printed, _ = gauge(capsys, tmp_path, "--remove-rigid", "--point", "60,80", "--out", tmp_path / "g.csv")
    assert rc == 0
    assert "step 2: too_few_points" in printed
    rows = (tmp_path / "g.csv").read_text().splitlines()
    assert sum(r.startswith("1,") for r in rows) == 6 + 6
    assert next(r for r in rows if r.startswith("2,")).count("no rigid motion") == 1
    rc, printed, _ = gauge(capsys, tmp_path, "--point", "60,80")
    assert "missing (low_correlation)" in printed


@pytest.mark.fault(37)
def test_a_cut_of_the_result_file_is_kept_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = Cuts([[(30.0, 100.0), (170.0, 100.0)]])
    opened = make_field(lambda x: x + np.where(x[..., 1:2] > -1.0, 0.5, 0.0) * [0.0, 1.0, 0.0], shape=flat, cuts=cut)
    write(tmp_path, 1, opened)
    rc, _, _ = gauge(capsys, tmp_path, "--line", "90,62,90,148,87", "--out", tmp_path / "g.json")
    assert rc == 0
    line = json.loads((tmp_path / "g.json").read_text())["steps"][0]["lines"][0]
    values = [(y, v) for y, v in zip(line["y_px"], line["values"]["v_mm"]["value"], strict=True) if v is not None]
    assert {round(v, 6) for _, v in values} == {0.0, 0.5}
    assert all((v == 0.0) == (y < 100.0) for y, v in values)
    assert "cut" in line["missing"]


def test_no_results_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        assert gauge(capsys, folder, "--point", "1,1")[2].startswith("stereorig: results_missing:")
    (tmp_path / "step_0000.nc").write_bytes(b"no netcdf")
    assert gauge(capsys, tmp_path, "--point", "1,1")[2].startswith("stereorig: file_unreadable:")
    fill(tmp_path / "exports" / "measure")
    (tmp_path / "step_0000.nc").unlink()
    assert gauge(capsys, tmp_path, "--point", "60,80")[0] == 0


def test_fields_are_written_in_the_frame_and_without_the_motion(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--align", "plane", "--x-direction", "0,1,0", "--remove-rigid")
    out = tmp_path / "moved"
    rc, printed, err = gauge(
        capsys, results, *options, "--point", "60,80", "--field-out", out, "--out", tmp_path / "a.json"
    )
    assert (rc, err) == (0, "")
    assert "fields written: 3 files" in printed
    # read without any option, the new files show what the old ones do with them
    assert gauge(capsys, out, "--point", "60,80", "--out", tmp_path / "b.json")[0] == 0
    a, b = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert a["frame"] == b["frame"]
    for old, new in zip(a["steps"], b["steps"], strict=True):
        assert (old["n"], old["label"], old["load_n"]) == (new["n"], new["label"], new["load_n"])
        for name, number in old["points"][0]["values"].items():
            got = new["points"][0]["values"][name]
            assert got["value"] == pytest.approx(number["value"], abs=1e-12)
            assert got["sigma"] == pytest.approx(number["sigma"], rel=1e-4)
    moved, measured = (read_field(folder / "step_0002.nc") for folder in (out, results))
    np.testing.assert_array_equal(moved.status, measured.status)
    assert np.nanmean(np.abs(moved.uvw_mm)) < 0.05 < np.nanmean(np.abs(measured.uvw_mm))
    head = read_head(out / "step_0002.nc")
    transformation = json.loads(str(head.attributes["transformation"]))
    assert transformation["align"]["kind"] == "plane"
    assert transformation["rigid_motion"]["values"]["rotation_z_rad"]["value"] is not None
    assert head.inputs_sha256 == INPUTS
    for wrong in ((results, *options, "--field-out", results), (results, "--point", "60,80", "--field-out", out)):
        rc, _, err = gauge(capsys, *wrong)
        assert rc == 1
        assert err.startswith(("stereorig: output_unusable:", "stereorig: option_conflict:"))


def test_strain_is_made_anew_along_the_new_axes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = stretched(0.03)
    strain = surface_strain(field, StrainOptions(window=3), subset_px=SUBSET)
    (tmp_path / "in").mkdir()
    write_field(tmp_path / "in" / "step_0001.nc", field, Provenance({"subset_px": SUBSET}, INPUTS, "1", step=1), strain)
    rc, _, err = gauge(
        capsys, tmp_path / "in", "--align", "plane", "--x-direction", "0,1,0", "--field-out", tmp_path / "out"
    )
    assert (rc, err) == (0, "")
    turned = read_strain(tmp_path / "out" / "step_0001.nc")
    assert turned is not None
    assert np.nanmean(turned.strain[..., 1]) == pytest.approx(0.5 * (1.03**2 - 1.0), abs=1e-6)
    assert np.nanmean(turned.strain[..., 0]) == pytest.approx(0.5 * (0.991**2 - 1.0), abs=1e-6)


# API ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def url(service: Service, client: httpx.Client) -> str:
    test_id = new_test(client)
    document = service.tests.analyses.create(test_id, {"kind": "displacement", "steps": [0, 1, 2]})
    fill(service.tests.analyses.path(test_id, document.id))
    return f"{API}/tests/{test_id}/analyses/{document.id}/gauges"


def test_api_and_command_line_give_the_same_document(
    client: httpx.Client, url: str, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body = {**BODY, "align": {"kind": "plane"}, "remove_rigid": {"rectangle_px": [54, 74, 124, 102]}}
    answer = client.post(url, json=body)
    assert answer.status_code == 200, answer.text
    more = ("--align", "plane", "--remove-rigid", "54,74,124,102", "--out", tmp_path / "g.json")
    assert gauge(capsys, results, *OPTIONS, *more)[0] == 0
    of_file, of_api = json.loads((tmp_path / "g.json").read_text()), answer.json()
    of_file.pop("inputs_sha256"), of_api.pop("inputs_sha256")  # each has its own time of creation
    assert of_api.pop("next_cursor") is None
    for document in (of_file, of_api):
        # the API's test has no steps at all: its results are stale, those of the folder know no test
        document.pop("stale"), document.pop("stale_reasons")
        for step in document["steps"]:
            step.setdefault("rigid_motion", None)
            step.setdefault("problem", None)
    assert of_api == of_file


def test_an_evaluation_answers_over_the_api_as_the_command_does(
    client: httpx.Client, url: str, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {"variable": "w_mm", "lower": -1.0, "upper": 0.5, "step": 2}
    at = url.removesuffix("gauges") + "evaluations"
    answer = client.post(f"{at}/conformity", json={"settings": settings}, timeout=60.0)
    assert answer.status_code == 200, answer.text
    given = [part for name, value in settings.items() for part in ("--set", f"{name}={value}")]
    capsys.readouterr()
    main(["evaluate", "conformity", str(results), *given, "--json"])
    assert answer.json() == {"name": "conformity", "document": json.loads(capsys.readouterr().out)}
    listed = client.get(f"{API}/evaluations", timeout=60.0).json()["evaluations"]
    shown = next(one for one in listed if one["name"] == "conformity")
    assert set(settings) <= set(shown["settings"]["properties"])
    assert set(answer.json()["document"]) == set(shown["document"]["properties"])
    for name, settings, status, code in (
        ("conformity", {"variable": "w_mm"}, 422, "evaluation_settings"),
        ("conformity", {"variable": "none", "upper": 1.0}, 422, "evaluation_needs"),
        ("nothing", {}, 404, "evaluation_missing"),
    ):
        refused = client.post(f"{at}/{name}", json={"settings": settings}, timeout=60.0)
        assert (refused.status_code, refused.json()["code"]) == (status, code)


def test_a_field_over_the_api_is_the_command_lines(
    client: httpx.Client, url: str, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body = {"align": {"kind": "plane"}, "remove_rigid": {"robust": True}}
    answer = client.post(f"{url}/field", params={"step": 2}, json=body)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/x-netcdf"
    (tmp_path / "api.nc").write_bytes(answer.content)
    rc, _, err = gauge(capsys, results, "--align", "plane", "--remove-rigid", "--robust", "--field-out", tmp_path / "f")
    assert (rc, err) == (0, "")
    of_api, of_file = read_field(tmp_path / "api.nc"), read_field(tmp_path / "f" / "step_0002.nc")
    np.testing.assert_allclose(of_api.uvw_mm, of_file.uvw_mm, atol=1e-12)
    np.testing.assert_allclose(of_api.covariance, of_file.covariance, rtol=1e-6)
    assert client.post(f"{url}/field", params={"step": 7}, json=body).status_code == 404
    assert client.post(f"{url}/field", params={"step": 2}, json={"areas": [{}]}).json()["code"] == "option_conflict"


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({}, 422, "invalid_request"),
        ({"points": [{"xy_px": [60, 80]}], "colour": 1}, 422, "invalid_request"),
        ({"points": [{"xy_px": [60, True]}]}, 422, "invalid_request"),
        ({"points": [{"xy_px": [60, 1e308]}]}, 422, "invalid_request"),
        ({"points": [{"xy_px": [60, 80], "name": "a"}, {"xy_px": [61, 80], "name": "a"}]}, 422, "values_disagree"),
        ({"areas": [{"rectangle_px": [60, 80, 10, 20]}]}, 422, "values_disagree"),
        ({"points": [{}]}, 422, "invalid_request"),
        ({"points": [{"xy_px": [60, 80], "xy_mm": [0, 0]}]}, 422, "invalid_request"),
        ({"extensometers": [{"a_px": [60, 80]}]}, 422, "invalid_request"),
        ({"extensometers": [{"ends_mm": [[0, 0], [99, 0]]}]}, 422, "gauge_outside"),
        ({"align": {"kind": "2-2-2"}}, 422, "invalid_request"),
        ({"points": [{"xy_px": [6, 8]}]}, 422, "gauge_outside"),
        ({"areas": [{}], "variables": ["colour"]}, 404, "field_missing"),
        ({"areas": [{}], "steps": [9]}, 422, "step_missing"),
        ({"align": {"kind": "plane", "rectangle_px": [54, 75, 124, 79]}}, 422, "gauge_outside"),
        ({"align": {"kind": "plane", "rectangle_px": [54, 73, 124, 75]}}, 409, "too_few_points"),
        ({"lines": [{"vertices_px": [[60, 80], [90, 80]], "count": 100_000}] * 10}, 422, "gauge_too_large"),
    ],
)
def test_bad_requests_are_problems(
    client: httpx.Client, url: str, body: dict[str, Any], status: int, code: str
) -> None:
    answer = client.post(url, json=body)
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert answer.json()["remedy"]


def test_unknown_and_unfinished_analyses(service: Service, client: httpx.Client, url: str) -> None:
    missing = url.rsplit("/", 2)[0] + "/a999999-abcdef/gauges"
    assert client.post(missing, json=BODY).status_code == 404
    test_id = url.split("/tests/")[1].split("/")[0]
    empty = service.tests.analyses.create(test_id, {"kind": "displacement", "steps": [0]})
    answer = client.post(f"{API}/tests/{test_id}/analyses/{empty.id}/gauges", json=BODY)
    assert (answer.status_code, answer.json()["code"]) == (409, "no_results")


def test_the_examples_of_the_document_are_valid_requests(client: httpx.Client, url: str) -> None:
    schema = client.get(f"{API}/openapi.json").json()
    (path,) = [p for p in schema["paths"] if p.endswith("/gauges")]
    examples = schema["paths"][path]["post"]["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) == 2
    for example in examples.values():
        answer = client.post(url, json=example["value"])
        assert (answer.status_code, answer.json()["code"]) in ((422, "gauge_outside"), (422, "step_missing"))
