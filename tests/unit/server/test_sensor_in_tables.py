"""The sensor's part of a budget is in the readings' table."""

from __future__ import annotations

from stereorig.server.formats.gauges.readings import Number
from stereorig.server.formats.gauges.table import GaugeRow, _rows


def test_a_sensors_part_has_a_column_of_its_own() -> None:
    number = Number(0.5, 0.01, "mm", None, {"matching": 0.006, "sensor": 0.008})
    (row,) = _rows(GaugeRow(step=1, label="", load_n=None), {"u_mm": number}, "")
    assert (row.u_matching, row.u_sensor, row.u_target) == (0.006, 0.008, None)
