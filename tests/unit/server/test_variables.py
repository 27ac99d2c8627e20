"""The table of variables against the result files that are written, and against what people expect of each quantity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.documents.results import FieldVariable
from stereorig.server.formats.results.variables import STRAIN, VARIABLES, Variable, described
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.results.reader import list_variables
from tests.support.strain_fields import make_field


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FieldVariable]:
    field = make_field(
        lambda a, b: np.stack([a, b, 0.01 * a * b], axis=-1), lambda x: 1.001 * x, shape=(9, 9), spacing_px=8.0
    )
    path = tmp_path_factory.mktemp("results") / "step_0001.nc"
    strain = surface_strain(field, StrainOptions(window=5), subset_px=21)
    write_field(path, field, Provenance(settings={}, inputs={}, software_version="0"), strain)
    return {one.name: one for one in list_variables(path)}


def test_each_variable_of_a_file_has_the_unit_and_the_meaning_of_its_row(heads: dict[str, FieldVariable]) -> None:
    rows = {name: row for name, row in VARIABLES.items() if name in heads}
    assert {"x_px", "x_mm", "w_mm", "d_mm", "exx", "von_mises", "zncc", "status", "strain_status"} <= set(rows)
    for name, row in rows.items():
        assert heads[name].units == row.units
        assert heads[name].long_name == row.long_name.format(tensor="Green-Lagrange strain")
    assert heads["sigma_e1"].long_name == "standard deviation of e1, linearised"


def test_every_displacement_strain_and_position_is_listed_under_its_heading(heads: dict[str, FieldVariable]) -> None:
    found: dict[str, set[str]] = {}
    for one in heads.values():
        found.setdefault(one.group, set()).add(one.name)
    assert found["Displacement"] == {"u_mm", "v_mm", "w_mm", "d_mm"}
    assert found["Shape"] == {"x_mm", "y_mm", "z_mm"}
    assert found["Strain"] == {"exx", "eyy", "exy", "e1", "e2", "max_shear", "von_mises", "strain_angle_rad"}
    assert found["Quality"] == {"status", "strain_status", "zncc", "epipolar_px", "noise_grey"}
    assert found["Standard uncertainty"] == {name for name in heads if name.startswith("sigma_")}


def test_every_displacement_strain_and_position_has_its_standard_deviation(heads: dict[str, FieldVariable]) -> None:
    numbers = [one.name for one in heads.values() if one.group in ("Displacement", "Strain", "Shape")]
    assert [name for name in numbers if f"sigma_{name}" not in heads] == []


def test_strains_are_shown_in_micrometres_per_metre_and_are_zero_at_the_reference(
    heads: dict[str, FieldVariable],
) -> None:
    strains = {"exx", "eyy", "exy", "e1", "e2", "max_shear", "von_mises"}
    in_microstrain = {one.name for one in heads.values() if one.kind == "strain"}
    patches = {f"{name}_patch" for name in ("exx", "eyy", "exy")} & set(heads)
    assert in_microstrain == strains | patches | {f"sigma_{name}" for name in strains}
    assert described("expanded_exx").kind == "strain"
    assert heads["strain_angle_rad"].kind == "angle"
    assert {one.name for one in heads.values() if one.relative} == strains | {"u_mm", "v_mm", "w_mm", "d_mm"}


@pytest.mark.parametrize(
    ("part", "names"),
    [
        ("none", "x_px status zncc iterations epipolar_px theta_rad strain_status e1 sigma_e2 max_shear"),
        ("field", "x_mm sigma_w_mm covariance rotation_x_rad normal_z d_mm common_factor"),
        ("strain", "exx sigma_exy eyy_patch strain_angle_rad strain_covariance_exx_eyy common_factor_strain"),
    ],
)
def test_other_axes_change_components_and_leave_invariants(part: str, names: str) -> None:
    assert {name: described(name).part for name in names.split()} == dict.fromkeys(names.split(), part)


def test_a_further_strain_is_one_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    areal = Variable(
        "areal",
        "1",
        "{tensor}, exx + eyy",
        lambda strain: strain.strain[..., 0] + strain.strain[..., 1],
        label="areal strain",
        group="Strain",
        kind="strain",
        part="none",
    )
    monkeypatch.setattr("stereorig.server.formats.results.strain.STRAIN", (*STRAIN, areal))
    monkeypatch.setitem(VARIABLES, "areal", areal)
    field = make_field(
        lambda a, b: np.stack([a, b, 0.0 * a], axis=-1), lambda x: 1.01 * x, shape=(9, 9), spacing_px=8.0
    )
    write_field(
        tmp_path / "step_0001.nc",
        field,
        Provenance(settings={}, inputs={}, software_version="0"),
        surface_strain(field, StrainOptions(window=5, tensor="infinitesimal"), subset_px=21),
    )
    head = next(one for one in list_variables(tmp_path / "step_0001.nc") if one.name == "areal")
    assert (head.label, head.group, head.kind) == ("areal strain", "Strain", "strain")
