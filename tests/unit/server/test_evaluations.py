"""The evaluations' door with good and broken packages, and the conformity of points beside drawn true values."""

from __future__ import annotations

import json
import sys
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
from pydantic import BaseModel

from stereorig.core.errors import StereorigError
from stereorig.core.progress import no_progress
from stereorig.server.cli.main import main
from stereorig.server.evaluations import door
from stereorig.server.evaluations.conformity import ConformityOfPoints
from stereorig.server.evaluations.door import Evaluated, described, evaluate, evaluation
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.document_scripts import one_block
from tests.support.document_scripts import run as run_command
from tests.support.gauge_field import SUBSET, make_field

PAGE = "docs/how_to/evidence/evaluations.md"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A shape, and a step whose w runs from -0.1 to 0.1 mm over the columns, with a standard uncertainty of 0.02 mm."""
    folder = tmp_path / "results"
    folder.mkdir()
    shape = make_field(None, growing=False)
    write_field(folder / "step_0000.nc", shape, Provenance({"subset_px": SUBSET}, {}, "1"))
    moved = make_field(lambda x: x, growing=False)
    assert moved.uvw_mm is not None
    uvw, covariance = moved.uvw_mm.copy(), moved.covariance.copy()
    uvw[..., 2] = np.linspace(-0.1, 0.1, moved.shape[1])
    covariance[..., 5, 5] = 0.02**2
    moved = replace(moved, uvw_mm=uvw, covariance=covariance)
    write_field(folder / "step_0001.nc", moved, Provenance({"subset_px": SUBSET}, {}, "1", step=1))
    return folder


def judged(results: Path, **settings: Any) -> dict[str, Any]:
    asked = {"variable": "w_mm", **settings}
    files = sorted(results.glob("*.nc"))
    return evaluate(ConformityOfPoints(), files, asked, no_progress).document.model_dump()


def test_points_are_judged_as_often_as_drawn_true_values_lie_within(results: Path) -> None:
    rng = np.random.default_rng(1)
    w = np.linspace(-0.1, 0.1, 17)
    within = (np.abs(w[:, None] + 0.02 * rng.standard_normal((17, 200_000))) <= 0.06).mean(axis=1)
    assert np.abs(within - 0.95).min() > 0.005, "no point at the border, where the draw would decide"
    assert np.abs(within - 0.05).min() > 0.005
    found = judged(results, lower=-0.06, upper=0.06)
    columns = int((within >= 0.95).sum()), int((within <= 0.05).sum())
    expected = [14 * n for n in (*columns, 17 - sum(columns))]
    assert [found["conforming"], found["failing"], found["undecided"]] == expected
    assert found["verdict"] == "does not conform"
    assert found["accepted"] is False
    assert sum(found["histogram"]["counts"]) == found["points"] == 14 * 17
    assert found["mean"] == pytest.approx(0.0, abs=1e-12)
    assert (found["minimum"], found["maximum"]) == pytest.approx((-0.1, 0.1))


@pytest.mark.parametrize(
    ("settings", "verdict"),
    [
        ({"upper": 0.2}, "conforms"),
        ({"upper": 0.11}, "undecided"),
        ({"lower": 0.0, "share": 0.2}, "conforms"),
        ({"lower": 0.0, "share": 0.9}, "does not conform"),
    ],
)
def test_the_verdict_follows_limits_and_share(results: Path, settings: dict[str, Any], verdict: str) -> None:
    assert judged(results, **settings)["verdict"] == verdict


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({}, "evaluation_settings"),
        ({"lower": 1.0, "upper": 0.5}, "evaluation_settings"),
        ({"upper": 1.0, "variable": "exx"}, "evaluation_needs"),  # strain was switched off
        ({"upper": 1.0, "variable": "nonsense"}, "evaluation_needs"),
        ({"upper": 1.0, "step": 7}, "step_missing"),
    ],
)
def test_settings_and_results_that_do_not_fit_are_refused(results: Path, settings: dict[str, Any], code: str) -> None:
    with pytest.raises(StereorigError) as error:
        judged(results, **settings)
    assert error.value.code == code


class Nothing(BaseModel):
    """No settings."""


def broken(**change: Any) -> Any:
    """An evaluation that declares everything, with changes."""
    declared = {"name": "broken", "title": "Broken", "settings": Nothing, "document": Nothing, "needs": frozenset()}
    return SimpleNamespace(**{**declared, "run": lambda *_: Evaluated(Nothing()), **change})


@pytest.mark.parametrize("answer", [None, 3, Evaluated(ConformityOfPoints.settings(variable="w_mm", upper=1.0))])
def test_another_answer_than_its_document_is_an_error(results: Path, answer: Any) -> None:
    with pytest.raises(StereorigError) as error:
        evaluate(broken(run=lambda *_: answer), sorted(results.glob("*.nc")), {}, no_progress)
    assert error.value.code == "evaluation_failed"


def test_an_exception_of_an_evaluation_is_an_error_of_the_tree(results: Path) -> None:
    with pytest.raises(StereorigError) as error:
        evaluate(broken(run=lambda *_: 1 / 0), sorted(results.glob("*.nc")), {}, no_progress)
    assert error.value.code == "evaluation_failed"
    assert "ZeroDivisionError" in error.value.cause


def test_a_package_that_does_not_load_is_listed_with_its_problem_and_hinders_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entries = [
        EntryPoint("conformity", "stereorig.server.evaluations.conformity:ConformityOfPoints", door.GROUP),
        EntryPoint("gone", "no_such_package:Thing", door.GROUP),
        EntryPoint("bare", "types:SimpleNamespace", door.GROUP),
    ]
    monkeypatch.setattr(door, "entry_points", lambda group: entries)
    found = {one.name: one for one in described()}
    assert found["conformity"].problem == ""
    assert "no_such_package" in found["gone"].problem
    assert "declares no name" in found["bare"].problem
    with pytest.raises(StereorigError) as error:
        evaluation("gone")
    assert error.value.code == "evaluation_broken"
    with pytest.raises(StereorigError) as error:
        evaluation("other")
    assert error.value.code == "evaluation_missing"


def test_the_command_lists_evaluates_writes_and_ends_with_the_verdict(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate"]) == 0
    assert "conformity: Conformity with limits" in capsys.readouterr().out
    limits = ["--set", "variable=w_mm", "--set", "lower=-0.06", "--set", "upper=0.06"]
    assert main(["evaluate", "conformity", str(results), *limits, "--out", str(tmp_path / "out")]) == 1
    assert "verdict: does not conform" in capsys.readouterr().out
    document = json.loads((tmp_path / "out" / "conformity.json").read_text())
    assert document["verdict"] == "does not conform"
    values = meshio.read(tmp_path / "out" / "conformity.vtu").point_data["conformity_w_mm"]
    assert (int((values == 1).sum()), int((values == -1).sum())) == (document["conforming"], document["failing"])
    assert main(["evaluate", "conformity", str(results), "--set", "variable=w_mm", "--set", "upper=0.5"]) == 0


def test_the_package_of_the_how_to_is_found_once_it_is_installed(results: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    about = tomllib.loads(one_block(PAGE, "toml", "entry-points"))["project"]
    folder = site / f"{about['name']}-{about['version']}.dist-info"  # as pip leaves it
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {about['name']}\nVersion: {about['version']}\n")
    entries = [f"{name} = {value}" for name, value in about["entry-points"][door.GROUP].items()]
    (folder / "entry_points.txt").write_text("\n".join([f"[{door.GROUP}]", *entries]))
    (site / "flatness.py").write_text(one_block(PAGE, "python", "class Flatness"))
    source = f"""
import sys
sys.path.insert(0, {str(site)!r})
from stereorig.server.cli.main import main
sys.exit(main())
"""
    command = [sys.executable, "-c", source, "evaluate", "flatness", str(results), "--set", "limit_mm=10", "--json"]
    done = run_command(command, tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    points = make_field(None, growing=False).xyz_mm.reshape(-1, 3)
    # a bent surface: least squares in z, which the fit at right angles meets within a hundredth
    A = np.c_[points[:, :2], np.ones(len(points))]
    plane, *_ = np.linalg.lstsq(A, points[:, 2], rcond=None)
    height = (points[:, 2] - A @ plane) / np.sqrt(1.0 + plane[:2] @ plane[:2])
    assert found["flatness_mm"] == pytest.approx(np.ptp(height), rel=1e-2)
    assert found["points"] == len(points)
