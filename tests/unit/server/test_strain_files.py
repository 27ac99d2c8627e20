"""Strain in result files, summaries and settings."""

from __future__ import annotations

import json

import netCDF4
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.settings import StrainSettings
from stereorig.core.strain import StrainOptions, StrainStatus, surface_strain
from stereorig.server.compute.strain import strain_of_step, summarise_strain
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.strain_fields import make_field, plane

F = np.array([[1.001, 0.0004, 0], [-0.0002, 0.9995, 0], [0, 0, 1]])
PROVENANCE = Provenance(settings={}, inputs={}, software_version="0")


@pytest.fixture
def strain_and_file(tmp_path):
    field = make_field(plane, lambda p: p @ F.T)
    strain = surface_strain(field, StrainOptions(window=7, tensor="hencky", order=2), subset_px=21)
    write_field(tmp_path / "step_0001.nc", field, PROVENANCE, strain)
    return strain, tmp_path / "step_0001.nc"


def test_written_and_read_back(strain_and_file):
    strain, path = strain_and_file
    back = read_strain(path)
    assert back.options == strain.options
    assert (back.gauge_px, back.spacing_px, back.subset_px) == (81.0, 10.0, 21)
    assert back.gauge_mm == pytest.approx(strain.gauge_mm)
    np.testing.assert_array_equal(back.status, strain.status)
    np.testing.assert_allclose(back.strain, strain.strain, rtol=1e-6)
    np.testing.assert_allclose(back.sigma, strain.sigma, rtol=1e-6)
    np.testing.assert_allclose(back.covariance, strain.covariance, rtol=1e-5, atol=1e-17)
    np.testing.assert_allclose(back.patch, strain.patch, rtol=1e-6)
    assert read_field(path).has_motion


def test_variables_say_what_they_are(strain_and_file):
    strain, path = strain_and_file
    with netCDF4.Dataset(path) as data:
        exx = data["exx"]
        assert (exx.units, exx.gauge_px, exx.window_points) == ("1", 81.0, 7)
        assert exx.gauge_mm == pytest.approx(strain.gauge_mm)
        assert "Hencky" in exx.long_name
        assert data["exx_patch"].gauge_px == 21.0
        assert "sqrt" in data["von_mises"].long_name
        np.testing.assert_allclose(data["e1"][...].filled(np.nan), strain.principal[..., 0], rtol=1e-6)
        meanings = data["strain_status"].flag_meanings.split()
        assert meanings[StrainStatus.TOO_FEW] == "too_few"
        assert "X_sys" in data.strain_axes


def test_a_file_without_strain(tmp_path):
    field = make_field(plane, lambda p: p)
    write_field(tmp_path / "a.nc", field, PROVENANCE)
    assert read_strain(tmp_path / "a.nc") is None
    with pytest.raises(FileFormatError) as error:
        read_strain(tmp_path / "b.nc")
    assert error.value.code == "file_missing"
    (tmp_path / "c.nc").write_text("nothing")
    with pytest.raises(FileFormatError) as error:
        read_strain(tmp_path / "c.nc")
    assert error.value.code == "file_unreadable"
    with netCDF4.Dataset(tmp_path / "a.nc", "a") as data:
        data.strain = json.dumps({"window": 9})
    with pytest.raises(FileFormatError) as error:
        read_strain(tmp_path / "a.nc")
    assert error.value.code == "file_unreadable"


def test_summary_in_microstrain():
    rng = np.random.default_rng(3)
    field = make_field(plane, lambda p: p @ F.T + rng.normal(0.0, 3e-4, p.shape))
    # white from point to point: a step as wide as the subset
    strain = surface_strain(field, StrainOptions(window=5, tensor="infinitesimal"), subset_px=9)
    summary = summarise_strain(strain, field).document()
    mean, sd, floor = (summary[f"{n}_microstrain"] for n in ("mean", "sd", "noise_floor"))
    for name, truth in (("exx", 1000.0), ("eyy", -500.0), ("exy", 100.0)):
        assert mean[name] == pytest.approx(truth, abs=0.4 * sd[name])
        assert sd[name] == pytest.approx(floor[name], rel=0.4)  # edges are noisier
    assert summary["points"] == strain.valid.sum()
    assert summary["patch"]["mean_microstrain"]["exx"] == 0.0
    assert summary["patch"]["difference_mean_microstrain"]["exx"] == pytest.approx(-mean["exx"])
    json.dumps(summary, allow_nan=False)


def test_summary_of_nothing():
    field = make_field(plane, lambda p: p, shape=(4, 4))
    strain = surface_strain(field, StrainOptions(window=21), subset_px=9)
    summary = summarise_strain(strain, field).document()
    assert (summary["points"], summary["gauge_mm"], summary["mean_microstrain"]["exx"]) == (0, None, None)
    json.dumps(summary, allow_nan=False)


def test_settings_and_back():
    options = StrainOptions(window=5, order=2, tensor="infinitesimal")
    settings = StrainSettings(window=5, order=2, tensor="infinitesimal")
    assert StrainOptions.of(settings) == options
    assert StrainOptions.of(StrainSettings.model_validate(settings.model_dump(mode="json"))) == options
    assert StrainOptions.of(None) is None
    with pytest.raises(ValueError, match="odd"):
        StrainSettings.model_validate({"window": 6})
    with pytest.raises(InputError):
        StrainOptions(window=6)
    field = make_field(plane, lambda p: p)
    assert strain_of_step(field, None, subset_px=21) is None
