"""A model kept with a test and compared: API, command line, VTU, report; bad files refused with nothing kept."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import meshio
import numpy as np
import pytest

from stereorig.server.cli.main import main
from stereorig.server.report.build import make_report
from stereorig.server.report.source import find_source
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.model_bench import MM_PER_PX, bench, kirsch, mesh, write_model, write_result
from tests.support.service_rig import new_test, served, tiny_config

API = "/api/v1"
SHAPE = (31, 31)
HOLE_MM = 1.2


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    running = Service(tiny_config(), tmp_path_factory.mktemp("models") / "data").start()
    yield running
    running.close()


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with served(service) as one:
        yield one


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("results")
    displacement = kirsch(radius_mm=HOLE_MM)
    field = bench(displacement, shape=SHAPE, hole_mm=HOLE_MM).replicate(np.random.default_rng(8))
    write_result(made, field)
    for name, stiffness, per_mm in (("right.vtu", 1.0, 1.0), ("wrong.xdmf", 1.25, 1.0), ("metres.vtu", 1.0, 1e-3)):
        surface = mesh(kirsch(stiffness, radius_mm=HOLE_MM), half_mm=6.0, hole_mm=HOLE_MM)
        write_model(made / name, surface, per_mm=per_mm)
    return made


@pytest.fixture(scope="module")
def url(service: Service, client: httpx.Client, folder: Path) -> str:
    """Of an analysis with the result of step 1."""
    test_id = new_test(client)
    document = service.tests.analyses.create(test_id, {"kind": "displacement", "steps": [1]})
    result = service.tests.analyses.path(test_id, document.id) / "step_0001.nc"
    result.write_bytes((folder / "step_0001.nc").read_bytes())
    return f"{API}/tests/{test_id}/analyses/{document.id}"


def kept(client: httpx.Client, url: str, *files: Path, **form: str) -> dict[str, Any]:
    named = zip(("file", "heavy"), files, strict=False)
    sent = {part: (path.name, path.read_bytes()) for part, path in named}
    answer = client.post(f"{url.split('/analyses')[0]}/models", files=sent, data=form)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def compared(client: httpx.Client, url: str, model: dict[str, Any], **body: Any) -> dict[str, Any]:
    answer = client.post(f"{url}/comparison", json={"model_id": model["id"], **body})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_the_right_model_is_accepted_and_a_stiff_one_refuted(client: httpx.Client, url: str, folder: Path) -> None:
    right = kept(client, url, folder / "right.vtu", unit="mm")
    assert right["unit"] == "mm"
    assert right["displacement"] == "displacement"
    found = compared(client, url, right)
    assert found["accepted"]
    assert found["refuted"] == []
    assert found["step"] == 1
    assert abs(found["factor"]["value"] - 1.0) < 4.0 * found["factor"]["sigma"]
    stiff = kept(client, url, folder / "wrong.xdmf", folder / "wrong.h5", unit="mm")
    found = compared(client, url, stiff)
    assert not found["accepted"]
    assert found["factor"]["value"] == pytest.approx(1.25, abs=4.0 * found["factor"]["sigma"])
    assert found["displacement"]["scale"]["probability"] < 1e-6


def test_the_vtu_holds_difference_and_z_at_each_point(
    client: httpx.Client, url: str, folder: Path, tmp_path: Path
) -> None:
    model = kept(client, url, folder / "metres.vtu", unit="m", align='{"kind": "best-fit"}')
    answer = client.post(f"{url}/comparison", params={"format": "vtu"}, json={"model_id": model["id"]})
    assert answer.status_code == 200, answer.text
    (tmp_path / "c.vtu").write_bytes(answer.content)
    data = meshio.read(tmp_path / "c.vtu").point_data
    whole = data["model_status"] == 0
    for name in ("u", "v", "w"):
        off = data[f"{name}_mm"] - data[f"model_{name}_mm"]
        np.testing.assert_allclose(data[f"difference_{name}_mm"][whole], off[whole], atol=1e-7)
        z = data[f"difference_{name}_mm"] / data[f"sigma_difference_{name}_mm"]
        np.testing.assert_allclose(data[f"z_{name}"][whole], z[whole], rtol=1e-5)
        # the noise of the drawn field, and no more: its mean square over the points has neighbours in common
        assert np.sqrt(np.mean(z[whole] ** 2)) == pytest.approx(1.0, abs=0.25)
    assert set(np.unique(data["region_refuted"])) == {0}
    assert np.nanmax(np.abs(data["z_exx"])) < 6.0


def test_the_command_says_the_same_and_ends_with_its_verdict(
    client: httpx.Client, url: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = kept(client, url, folder / "right.vtu", unit="mm")
    over_http = compared(client, url, model)
    args = ["compare-model", str(folder), "--model", str(folder / "right.vtu"), "--unit", "mm"]
    assert main([*args, "--out", str(tmp_path)]) == 0
    assert "the model is accepted" in capsys.readouterr().out
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert written["displacement"] == over_http["displacement"]
    assert written["regions"] == over_http["regions"]
    assert (tmp_path / "comparison.vtu").stat().st_size > 10_000
    assert main([*args[:3], str(folder / "wrong.xdmf"), *args[4:]]) == 1
    assert "REFUTED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("align", "shift"),
    [
        ("3-2-1:110,90,390,90,250,370,120,230,390,230,250,120", None),
        ("markers", (0.0, 0.0)),
        ("best-fit", (0.0, 0.0)),
        ('{"kind": "given", "origin_mm": [0, 0, 0]}', None),
    ],
)
def test_every_alignment_is_asked_for_on_the_command_line(
    align: str, shift: object, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ["compare-model", str(folder), "--model", str(folder / "right.vtu"), "--unit", "mm", "--align", align]
    if shift is not None:
        middle = np.array([100.0, 80.0]) + 150.0
        for x, y in ((110.0, 90.0), (390.0, 90.0), (110.0, 370.0), (390.0, 370.0)):
            at = (np.array([x, y]) - middle) * MM_PER_PX
            args += ["--marker", f"{x},{y},{at[0]},{at[1]},0"]
    rc = main([*args, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["align"]["kind"] == (align.split(":")[0] if not align.startswith("{") else "given")
    assert rc == (0 if found["accepted"] else 1)
    assert found["accepted"]


@pytest.mark.parametrize(
    ("content", "name", "form", "code"),
    [
        (b"x,y,z,u,v,w\n0,0,0,0,0,0\n", "m.csv", {}, "model_unit_missing"),
        (b"x_mm,y_mm\n", "m.csv", {}, "model_unreadable"),
        (b"<VTKFile", "m.vtu", {"unit": "mm"}, "model_unreadable"),
        (b"solid", "m.stl", {"unit": "mm"}, "model_unreadable"),
        (b"x_mm,y_mm,z_mm,u_mm,v_mm,w_mm\n0,0,0,0,0,0\n", "m.csv", {"align": "{}"}, "alignment_invalid"),
        (b"", "../../m.csv", {"unit": "mm"}, "model_unreadable"),
    ],
)
def test_what_cannot_be_used_is_refused_and_not_kept(
    client: httpx.Client, url: str, content: bytes, name: str, form: dict[str, str], code: str
) -> None:
    models = f"{url.split('/analyses')[0]}/models"
    before = client.get(models).json()["models"]
    answer = client.post(models, files={"file": (name, content)}, data=form)
    assert answer.status_code == 422
    assert answer.json()["code"] == code
    assert answer.json()["remedy"]
    assert client.get(models).json()["models"] == before


def test_a_model_elsewhere_is_kept_and_its_comparison_refused(client: httpx.Client, url: str, folder: Path) -> None:
    model = kept(client, url, folder / "metres.vtu", unit="mm")  # a thousand times too small
    answer = client.post(f"{url}/comparison", json={"model_id": model["id"]})
    assert answer.status_code == 422
    assert answer.json()["code"] == "model_no_overlap"
    away = {"kind": "given", "origin_mm": [0, 0, 2.0]}
    right = kept(client, url, folder / "right.vtu", unit="mm")
    answer = client.post(f"{url}/comparison", json={"model_id": right["id"], "align": away})
    assert answer.json()["code"] == "model_geometry_differs"


def test_models_are_listed_verified_and_deleted(service: Service, client: httpx.Client, url: str, folder: Path) -> None:
    models = f"{url.split('/analyses')[0]}/models"
    model = kept(client, url, folder / "wrong.xdmf", folder / "wrong.h5", unit="mm")
    assert set(model["files"]) == {"model.xdmf", "wrong.h5"}
    assert model["id"] in [one["id"] for one in client.get(models).json()["models"]]
    assert not [one for one in verify(service.folder.root).findings if "models" in one.path]
    path = service.models.path(model["test_id"], model["id"])
    (path / "wrong.h5").write_bytes(b"changed")
    assert [one.level for one in verify(service.folder.root).findings if "models" in one.path] == ["damaged"]
    answer = client.post(f"{url}/comparison", json={"model_id": model["id"]})
    assert answer.json()["code"] == "checksum_mismatch"
    assert client.delete(f"{models}/{model['id']}").status_code == 204
    assert not path.exists()
    assert client.delete(f"{models}/{model['id']}").status_code == 404


def test_the_report_shows_the_newest_models(service: Service, client: httpx.Client, url: str, folder: Path) -> None:
    stiff = kept(client, url, folder / "wrong.xdmf", folder / "wrong.h5", unit="mm")
    test_id, analysis_id = stiff["test_id"], url.split("/")[-1]
    page = make_report(find_source(service.tests.analyses.path(test_id, analysis_id))).page.decode()
    part = page[page.index('<section id="models">') :].split("</section>")[0]
    assert "wrong.xdmf" in part
    assert "The model is refuted" in part
    assert "data:image/png;base64," in part


def test_a_plane_model_is_compared_in_its_plane_by_every_door(
    service: Service, client: httpx.Client, url: str, folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    surface = mesh(kirsch(radius_mm=HOLE_MM), half_mm=6.0, hole_mm=HOLE_MM)
    flat = {"displacement": surface.displacement_mm[:, :2]}
    meshio.write(tmp_path / "plane.vtu", meshio.Mesh(surface.nodes_mm, [("triangle", surface.triangles)], flat))
    rows = np.column_stack([surface.displacement_mm[:, :2], surface.nodes_mm, 7.0 + surface.nodes_mm[:, :2]])
    titles = '"U:0","U:1","Points:0","Points:1","Points:2","disp:0","disp:1"'
    np.savetxt(tmp_path / "viewer.csv", rows, delimiter=",", header=titles, comments="")
    for name, form in (("plane.vtu", {}), ("viewer.csv", {"displacement": "U"})):
        model = kept(client, url, tmp_path / name, unit="mm", **form)
        found = compared(client, url, model)
        assert (found["left_out"], found["accepted"]) == ("w_mm", True)
        assert found["displacement"]["rms"]["w_mm"] is found["displacement"]["rms_z"]["w_mm"] is None
        assert found["regions"][0]["displacement"]["degrees"] == 2
        assert found["regions"][0]["difference"]["w_mm"] == {"value": None, "sigma": None, "units": "mm"}
        assert found["strain"]["rms"]["exx"] > 0.0
        answer = client.post(f"{url}/comparison", params={"format": "vtu"}, json={"model_id": model["id"]})
        (tmp_path / "c.vtu").write_bytes(answer.content)
        data = meshio.read(tmp_path / "c.vtu").point_data
        assert np.isnan(data["difference_w_mm"]).all()
        assert np.isfinite(data["difference_v_mm"][data["model_status"] == 0]).all()
        args = ["compare-model", str(folder), "--model", str(tmp_path / name), "--unit", "mm", "--align", "best-fit"]
        assert main([*args, *(["--displacement", form["displacement"]] if form else [])]) == 0
        assert "plane model: w is left out of difference, chi-square and verdict" in capsys.readouterr().out
    test_id, analysis_id = model["test_id"], url.split("/")[-1]
    page = make_report(find_source(service.tests.analyses.path(test_id, analysis_id))).page.decode()
    assert "A plane model: W is left out." in page
    models = f"{url.split('/analyses')[0]}/models"
    with (tmp_path / "viewer.csv").open("rb") as file:
        answer = client.post(models, files={"file": ("viewer.csv", file)}, data={"unit": "mm"})
    assert answer.json()["code"] == "model_displacement_unclear"
