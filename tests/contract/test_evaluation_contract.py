"""The rules that every evaluation keeps: those that are installed, and the one that the how-to builds."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.errors import StereorigError
from stereorig.core.progress import no_progress
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.evaluations import door
from stereorig.server.evaluations.door import Evaluation, document_of, evaluate, evaluation
from stereorig.server.evaluations.histories import Ends, Mean
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.document_scripts import one_block
from tests.support.gauge_field import SUBSET, make_field

GRID = (14, 17)
PAGE = "docs/how_to/evidence/evaluations.md"
NAMES = sorted(
    {entry.name for entry in entry_points(group=door.GROUP)}
    | {"conformity", "crack", "flatness", "resolution", "tensile"}
)


@pytest.fixture(autouse=True)
def how_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The how-to's package beside those that are installed."""
    (tmp_path / "flatness.py").write_text(one_block(PAGE, "python", "class Flatness"))
    monkeypatch.syspath_prepend(str(tmp_path))
    installed = list(entry_points(group=door.GROUP))
    shown = EntryPoint("flatness", "flatness:Flatness", door.GROUP)
    monkeypatch.setattr(door, "entry_points", lambda group: [*installed, shown])
    yield
    sys.modules.pop("flatness", None)


@pytest.fixture
def results(tmp_path: Path) -> list[Path]:
    """A shape and two stretched steps with strain and load; some points are lost."""
    failed = np.zeros(GRID, bool)
    failed[3:5, 6:9] = True
    files = []
    for n in range(3):
        field = make_field(None if n == 0 else lambda x, n=n: x * [1.0 + 0.01 * n, 1.0, 1.0], failed=failed)
        strain = None if n == 0 else surface_strain(field, StrainOptions(), subset_px=SUBSET)
        files.append(tmp_path / f"step_{n:04d}.nc")
        extra = {"load_n": f"{500.0 * n}"}
        write_field(files[-1], field, Provenance({"subset_px": SUBSET}, {}, "1", step=n, extra=extra), strain)
    return files


@pytest.mark.parametrize("gauge", [Mean("exx"), Ends((61.0, 88.0), (131.0, 88.0))])
def test_a_history_has_the_stretch_of_each_step_and_the_errors_that_steps_share(
    results: list[Path], gauge: Mean | Ends
) -> None:
    steps = door.Results(results)
    assert [steps.recorded(n).load_n for n in steps.steps] == [0.0, 500.0, 1000.0]
    found = steps.history(gauge)
    # x is stretched by 1 % and 2 %; the surface climbs by 0.05 + 0.04 x, of which x alone is stretched
    assert found.value == pytest.approx([0.0, 0.01, 0.02], rel=0.02)
    assert found.own[0] == 0.0
    assert (found.own[1:] > 0.0).all()
    assert not found.known, "the calibration's part is not known"


def settings_of(made: Evaluation) -> dict[str, Any]:
    """The schema's first example; nothing where every field has a default."""
    example: dict[str, Any] = made.settings.model_json_schema().get("examples", [{}])[0]
    return example


@pytest.mark.parametrize("name", NAMES)
def test_it_declares_name_title_and_described_fields(name: str) -> None:
    made = evaluation(name)
    assert door.NAME.fullmatch(made.name)
    assert made.title
    for model in (made.settings, made.document):
        for field, about in model.model_fields.items():
            assert about.description, f"{model.__name__}.{field} has no description"
    json.dumps([made.settings.model_json_schema(), made.document.model_json_schema()])


@pytest.mark.parametrize("name", NAMES)
def test_it_answers_with_its_document_and_changes_no_file(name: str, results: list[Path]) -> None:
    made = evaluation(name)
    before = [hashlib.sha256(path.read_bytes()).digest() for path in results]
    outcome = evaluate(made, results, settings_of(made), no_progress)
    document = document_of(outcome)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    made.document.model_validate(document)
    assert document == document_of(evaluate(made, results, settings_of(made), no_progress))
    assert outcome.step in range(3)
    for variable, one in outcome.variables.items():
        assert one.values.shape == GRID, variable
        assert one.units
        assert one.long_name
    for ending, text in outcome.files.items():
        assert re.fullmatch(r"[a-z_]*\.[a-z]{2,5}", ending), "it ends a file's name, in the folder that was asked for"
        assert text
    assert [hashlib.sha256(path.read_bytes()).digest() for path in results] == before


@pytest.mark.parametrize("name", NAMES)
def test_a_step_without_valid_points_or_without_motion_is_an_error_of_the_tree_or_answered(
    name: str, tmp_path: Path
) -> None:
    made = evaluation(name)
    for k, failed in enumerate((np.ones(GRID, bool), np.zeros(GRID, bool))):
        path = tmp_path / f"{k}" / "step_0000.nc"
        path.parent.mkdir()
        write_field(path, make_field(None, failed=failed), Provenance({"subset_px": SUBSET}, {}, "1"))
        failure: StereorigError | None = None
        try:
            evaluate(made, [path], settings_of(made), no_progress)
        except StereorigError as error:
            failure = error
        if failure is not None:
            assert failure.code != "evaluation_failed", failure
            assert failure.remedy


@pytest.mark.parametrize("name", NAMES)
def test_a_setting_of_another_type_is_refused_by_its_name(name: str, results: list[Path]) -> None:
    made = evaluation(name)
    for field in made.settings.model_fields:
        with pytest.raises(StereorigError) as error:
            evaluate(made, results, {**settings_of(made), field: {"no": ["such"]}}, no_progress)
        assert error.value.code == "evaluation_settings"
        assert field in error.value.cause
