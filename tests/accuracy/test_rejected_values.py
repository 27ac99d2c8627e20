"""What was measured at rejected points is kept apart on request, and is nowhere else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support import field_bench as bench

MOTION = (0.02, -0.013, 0.03, 0.0006, -0.0004, 0.001)


def test_a_wrong_match_that_was_refused_can_be_looked_at(tmp_path: Path) -> None:
    first, now = bench.take("block", 0.0, MOTION), list(bench.take("block", 1.0, MOTION, seed=1))
    now[1] = now[1].copy()
    now[1][100:112, 110:122] = now[1][100:112, 160:172]  # a patch of something else in camera 2 at t
    grid = bench.grid(spacing_px=4.0)
    options = MeasureOptions(subset_px=21, keep_rejected=True)
    without = replace(options, keep_rejected=False)
    assert ReferencePair(bench.pair(), *first).motion(*now, grid, without).rejected is None
    field = ReferencePair(bench.pair(), *first).motion(*now, grid, options)
    kept = field.rejected
    assert kept is not None
    assert kept.uvw_mm is not None
    known = np.isfinite(kept.uvw_mm).all(axis=-1)
    assert known.any()
    assert not (known & field.valid).any()
    assert np.isfinite(kept.zncc[known]).all()
    assert np.isfinite(kept.epipolar_px[known]).all()
    path = tmp_path / "step_0001.nc"
    write_field(path, field, Provenance({}, {}, "test"))
    with xr.open_dataset(path) as data:
        np.testing.assert_array_equal(data.rejected_w_mm.values, kept.uvw_mm[..., 2])
        np.testing.assert_allclose(data.rejected_zncc.values, kept.zncc, rtol=1e-6)
        assert np.isnan(data.w_mm.values[known]).all()
