"""Every number that leaves the program says what its uncertainty is: k, what it includes, and what it does not."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.stats
import xarray as xr
from PIL import Image

from stereorig.core.common.factor import Causes
from stereorig.core.errors import InputError
from stereorig.core.settings import AnalysisSettings, Coverage
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.result import Result
from stereorig.server.cli.main import main
from stereorig.server.exports.request import ExportRequest
from stereorig.server.exports.run import export
from stereorig.server.exports.source import find_source
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.summary import summarise
from stereorig.server.formats.results.uncertainty import Included, coverage_of
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.results.field_forms import Part, encode, take
from stereorig.server.results.gauges.readings import read_gauges
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.results.reader import probe_result, read_variable
from stereorig.server.results.steps import ExportSource
from tests.support.export_results import CALIBRATION, COLS, ROWS, SETTINGS, write_results
from tests.support.gauge_field import SUBSET, make_field

LACKING = "calibration not included"
K95 = float(scipy.stats.norm.ppf(0.975))
NINETY_FIVE = Coverage(coverage=0.95, k=None)
COLUMNS = {0: ("calibration",), 1: ("calibration", "stage"), 2: ("calibration", "calibration", "target")}
"""Of each step's factor: a step does without the columns that it does not need."""
AREA = {"areas": [{"name": "all"}], "variables": ["x_mm", "w_mm", "exx"]}
TOLD = ("calibration", "stage", "target")


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results by a calibration without covariance."""
    folder = tmp_path_factory.mktemp("stated") / "imported"
    write_results(folder)
    return folder


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results by a calibration whose causes are told apart."""
    folder = tmp_path_factory.mktemp("stated") / "known"
    folder.mkdir()
    rng = np.random.default_rng(4)
    for n, columns in COLUMNS.items():
        field = make_field((lambda p: 1.001 * p) if n else None, rows=ROWS, cols=COLS)
        common = 1e-3 * rng.normal(size=(ROWS, COLS, field.covariance.shape[-1], len(columns)))
        frozen = 0.5 * field.covariance[..., 3:, 3:] if n else None
        field = replace(field, common=common, causes=Causes(columns, TOLD), frozen=frozen)
        strain = surface_strain(field, StrainOptions(window=5), subset_px=SUBSET) if n else None
        provenance = Provenance(SETTINGS, {"calibration": CALIBRATION}, "9.8.7", step=n)
        write_field(folder / f"step_{n:04d}.nc", field, provenance, strain)
    return folder


def made(source: ExportSource, out: Path, form: Any, **more: Any) -> list[Path]:
    out.mkdir(exist_ok=True)
    return list(export(source, ExportRequest(form, **more), out))


def texts(path: Path) -> list[str]:
    """What other programs read beside a file's numbers."""
    if path.suffix == ".csv":
        about = json.loads(pd.read_csv(path).about[0])
        meanings = [text for name, text in about["meaning"].items() if name.startswith("sigma_")]
        return [json.dumps(about["uncertainty"]), *meanings]
    if path.suffix == ".vtu":
        return [bytes(meshio.read(path).field_data["uncertainty_utf8"].astype(np.uint8)).decode()]
    if path.suffix == ".mat":
        about = scipy.io.loadmat(path, simplify_cells=True)["about"]
        return [about["uncertainty"], *(text for name, text in about["meaning"].items() if name.startswith("sigma_"))]
    if path.suffix in (".h5", ".nc"):
        with h5py.File(path) as file:
            each = [file[name].attrs for name in file if name.startswith("sigma_")]
            said = [one["includes" if path.suffix == ".nc" else "long_name"].decode() for one in each]
            return said if path.suffix == ".nc" else [*said, str(file.attrs["uncertainty"])]
    with Image.open(path) as picture:
        return [picture.info["comment"].decode() if path.suffix == ".gif" else picture.text["Provenance"]]  # type: ignore[attr-defined]


@pytest.mark.parametrize("form", ["nc", "csv", "vtu", "mat", "h5", "png", "gif"])
def test_every_export_says_whether_the_calibration_is_included(
    imported: Path, known: Path, tmp_path: Path, form: str
) -> None:
    for folder, lacks in ((imported, True), (known, False)):
        out = tmp_path / folder.name
        said = texts(made(find_source(folder), out, form, steps=[1])[0])
        assert said
        for text in said:
            assert (LACKING in text) == lacks
            assert "matching" in text
            assert lacks or "stage" in text


def test_expanded_uncertainties_stand_beside_the_standard_ones_on_request_alone(known: Path, tmp_path: Path) -> None:
    source = find_source(known)
    (plain,) = made(source, tmp_path, "csv", steps=[1])
    (wide,) = made(source, tmp_path / "k", "csv", steps=[1], coverage=NINETY_FIVE)
    one, two = pd.read_csv(plain, comment="#"), pd.read_csv(wide, comment="#")
    assert not [name for name in one if name.startswith("expanded_")]
    for name in ("w_mm", "x_mm", "exx"):
        np.testing.assert_allclose(two[f"expanded_{name}"], K95 * one[f"sigma_{name}"], rtol=1e-6)  # single precision
        np.testing.assert_array_equal(two[f"sigma_{name}"], one[f"sigma_{name}"])
    stated = json.loads(two.about[0])["uncertainty"]
    assert stated["k"] == pytest.approx(K95)
    assert stated["coverage"] == 0.95
    assert "normal" in stated["distribution"]
    assert "infinite" in stated["distribution"]
    (path,) = made(source, tmp_path, "h5", coverage=Coverage(k=2.0, coverage=None), variables=["expanded_w_mm"])
    with h5py.File(path) as file:
        np.testing.assert_allclose(file["expanded_w_mm"][1].ravel(), 2.0 * one["sigma_w_mm"], rtol=1e-6)
    with pytest.raises(InputError) as error:
        made(source, tmp_path, "nc", coverage=NINETY_FIVE)
    assert error.value.code == "option_conflict"


def test_two_factors_or_one_out_of_bounds_are_refused() -> None:
    with pytest.raises(InputError) as error:
        coverage_of(2.0, 0.95)
    assert error.value.code == "option_conflict"
    for k, share in ((0.0, None), (-1.0, None), (float("nan"), None), (11.0, None), (None, 1.0), (None, 0.0)):
        with pytest.raises(InputError) as error:
            coverage_of(k, share)
        assert error.value.code == "coverage_invalid"
    assert coverage_of(None, None).factor == 1.0
    assert coverage_of(2.0, None).share == pytest.approx(2.0 * scipy.stats.norm.cdf(2.0) - 1.0)


def test_forms_that_hold_matrices_hold_the_total_covariance_and_the_factor_by_cause(
    known: Path, tmp_path: Path
) -> None:
    source = find_source(known)
    stored = [xr.load_dataset(path) for path in source.files]
    names = "xyzuvw"
    # MATLAB: as they are, with the causes of the columns
    (path,) = made(source, tmp_path, "mat", steps=[2])
    held = scipy.io.loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(held["common_factor"], stored[2].common_factor.values)
    rows, cols = np.triu_indices(6)
    triangle = stored[2].covariance.values.reshape(-1, 21)
    np.testing.assert_array_equal(held["covariance"][..., rows, cols].reshape(-1, 21), triangle)
    assert held["about"]["parts"]["common_factor"].split() == list(COLUMNS[2])
    # VTU: the upper triangle and the factor as components
    path = made(source, tmp_path, "vtu", steps=[2])[0]
    mesh = meshio.read(path)
    np.testing.assert_array_equal(mesh.point_data["covariance"], triangle)
    assert mesh.point_data["common_factor"].shape[1] == 6 * len(COLUMNS[2])
    assert 'ComponentName1="x_mm_calibration_2"' in path.read_text()
    # CSV: where they are asked for
    (path,) = made(source, tmp_path, "csv", steps=[2], variables=["covariance", "common_factor", "sigma_u_mm"])
    table = pd.read_csv(path, comment="#")
    np.testing.assert_allclose(table["covariance_u_mm_u_mm"], table["sigma_u_mm"] ** 2, rtol=1e-5)
    F = stored[2].common_factor.values
    np.testing.assert_allclose(table["common_factor_w_mm_target_3"], F[..., 5, 2].ravel(), rtol=1e-7)
    assert sum(name.startswith("covariance_") for name in table) == 21
    # HDF5: a column is the same cause in all steps
    (path,) = made(source, tmp_path, "h5")
    with h5py.File(path) as file:
        assert file["common_factor"].attrs["parts"].decode().split() == [
            "calibration",
            "calibration",
            "stage",
            "target",
        ]
        stack, total = file["common_factor"][...], file["covariance"][...]
    np.testing.assert_array_equal(stack[1, ..., 0], stored[1].common_factor.values[..., 0])
    assert not stack[1, ..., [1, 3]].any()  # step 1 has neither the second of the calibration nor one of the target
    np.testing.assert_array_equal(stack[2, ..., 3], F[..., 2])
    for k in range(6):
        own = total[2, ..., k, k] - (stack[2, ..., k, :] ** 2).sum(axis=-1)
        assert (own > 0.0).all(), names[k]


def test_gauges_state_k_what_is_included_and_the_budget_in_every_form(
    imported: Path, known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--point", "120,120", "--extensometer", "80,80,180,150", "--area", "all", "--line", "60,80,180,80,4"]
    for folder, lacking in ((imported, LACKING), (known, "")):
        for suffix in ("json", "csv", "mat"):
            out = tmp_path / f"{folder.name}.{suffix}"
            assert main(["gauge", str(folder), *asked, "--coverage", "0.95", "--out", str(out)]) == 0
        assert (LACKING in capsys.readouterr().out) == bool(lacking)
        document = json.loads((tmp_path / f"{folder.name}.json").read_text())
        assert document["uncertainty"]["k"] == pytest.approx(K95)
        assert (LACKING in document["uncertainty"]["text"]) == bool(lacking)
        assert ("calibration" in document["uncertainty"]["not_included"]) == bool(lacking)
        step = document["steps"][1]
        numbers = [*step["points"][0]["values"].values(), *step["extensometers"][0]["values"].values()]
        for one in numbers:
            assert one["expanded"] == pytest.approx(K95 * one["sigma"])
            assert one["not_included"] == lacking
            squares = sum(part**2 for part in one["budget"].values())
            assert squares == pytest.approx(one["sigma"] ** 2)
        mean = step["areas"][0]["values"]["w_mm"]
        assert mean["mean_expanded"] == pytest.approx(K95 * mean["mean_sigma"])
        assert mean["not_included"] == lacking
        along = step["lines"][0]["values"]["u_mm"]
        np.testing.assert_allclose(
            np.array(along["expanded"], float), K95 * np.array(along["sigma"], float), rtol=1e-12
        )
        rows = list(csv.DictReader(io.StringIO(_table(tmp_path / f"{folder.name}.csv"))))
        assert {row["not_included"] for row in rows if row["sigma"]} == {lacking}
        row = next(r for r in rows if r["step"] == "1" and r["gauge"] == "e1" and r["quantity"] == "strain")
        parts = [float(row[f"u_{name}"] or 0.0) for name in ("matching", "reference", "calibration", "stage", "target")]
        assert np.sum(np.square(parts)) == pytest.approx(float(row["sigma"]) ** 2)
        assert float(row["expanded"]) == pytest.approx(K95 * float(row["sigma"]))
        held = scipy.io.loadmat(tmp_path / f"{folder.name}.mat", simplify_cells=True)
        assert (LACKING in held["about"]["uncertainty"]) == bool(lacking)
        said = [str(one) for one in np.atleast_1d(held["gauges"]["not_included"]) if np.size(one)]
        assert set(said) == ({lacking} if lacking else set())


def _table(path: Path) -> str:
    return "".join(line for line in path.read_text().splitlines(keepends=True) if not line.startswith("#"))


def test_a_probe_and_a_field_say_what_their_uncertainty_is(imported: Path, known: Path) -> None:
    for folder, lacking in ((imported, LACKING), (known, "")):
        path = folder / "step_0001.nc"
        probe = probe_result(path, 120.0, 120.0, NINETY_FIVE)
        one = probe.values["w_mm"]
        stored = xr.load_dataset(path)
        assert one.sigma == pytest.approx(float(stored.sigma_w_mm[probe.row, probe.col]))
        assert one.expanded == pytest.approx(K95 * float(one.sigma or 0.0))
        assert one.not_included == lacking
        assert one.budget is not None
        assert sum((part or 0.0) ** 2 for part in one.budget.values()) == pytest.approx(float(one.sigma or 0.0) ** 2)
        assert probe.values["exx"].budget is not None
        assert (LACKING in probe.uncertainty.text) == bool(lacking)
    part = take("w_mm", lambda name: read_variable(path, name), Part(), "u (k = 1) includes matching")
    assert len(encode(part, "png")) > len(encode(replace(part, note=""), "png"))  # a foot of its own
    with h5py.File(io.BytesIO(encode(part, "nc"))) as file:
        assert file.attrs["uncertainty"].decode() == "u (k = 1) includes matching"


def test_a_summary_has_the_medians_by_cause(imported: Path, known: Path) -> None:
    summary = summarise(read_field(known / "step_0001.nc")).document()
    budget: Any = summary["budget_median_mm"]
    assert list(budget["w_mm"]) == ["matching", "reference", "calibration", "stage", "target"]
    assert budget["w_mm"]["target"] == 0.0  # told apart, and none in this step
    stored = xr.load_dataset(known / "step_0001.nc")
    F = stored.common_factor.values.astype(float)
    assert budget["w_mm"]["stage"] == pytest.approx(np.median(np.abs(F[..., 5, 1])))
    assert budget["w_mm"]["matching"] == pytest.approx(budget["w_mm"]["reference"], rel=1e-3)  # half of the variance
    assert budget["x_mm"]["matching"] == 0.0  # a position's noise is the reference pair's
    summary = summarise(read_field(imported / "step_0001.nc")).document()
    assert list(summary["budget_median_mm"]["w_mm"]) == ["matching"]  # type: ignore[index]
    assert LACKING in str(summary["uncertainty_includes"])


def test_steps_that_do_not_all_include_the_calibration_do_not() -> None:
    whole = Included(True, ("matching", "reference", "calibration"))
    part = Included(False, ("matching", "reference"))
    assert Included.in_all([whole, whole]).text == "matching, reference, calibration"
    assert Included.in_all([whole, part]).lacking == LACKING


def test_a_mean_by_the_library_keeps_what_all_points_share(imported: Path, known: Path) -> None:
    for folder in (known, imported):
        field, strain = read_field(folder / "step_0001.nc"), read_strain(folder / "step_0001.nc")
        settings = AnalysisSettings.model_validate({"region": {}, "subset_px": SUBSET, "spacing_px": 7})
        result = Result(field, strain, settings, 1)
        by_gauge = read_gauges([folder / "step_0001.nc"], GaugeRequest.model_validate(AREA)).steps[0].areas[0].values
        for name in ("x_mm", "w_mm", "exx"):
            mean = result.area(name)
            assert mean.mean_sigma == pytest.approx(by_gauge[name].mean_sigma)
            assert mean.mean_reading.budget.document() == pytest.approx(by_gauge[name].mean_budget)
        assert (LACKING in result.uncertainty_includes) == (folder is imported)
        if field.common is not None:
            shared = np.linalg.norm(field.common[field.valid][:, 5].mean(axis=0))
            assert result.area("w_mm").mean_sigma > shared  # as all points' errors are one
            assert result.area("w_mm").mean_sigma_calibration == pytest.approx(shared)
