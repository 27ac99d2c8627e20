"""A load frame's record is read as programs write it, and gives each step the channels of its time."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.errors import StereorigError
from stereorig.server.formats.channel_table import read_channel_table
from stereorig.server.formats.channel_units import channel_name, unit_of


@pytest.mark.parametrize(
    ("title", "unit", "name", "shown"),
    [
        ("Force", "kN", "force_kn", "kN"),
        ("Stroke", "mm", "stroke_mm", "mm"),
        ("Temperature", "°C", "temperature_c", "degC"),
        ("Axial strain", "%", "axial_strain_percent", "%"),
        ("Stress", "N/mm²", "stress_mpa", "MPa"),
        ("Crosshead speed", "mm/min", "crosshead_speed_mm_min", "mm/min"),
        ("Cycle", "", "cycle", "1"),
        ("force_kn", "kN", "force_kn", "kN"),
    ],
)
def test_a_channels_name_ends_in_its_unit(title: str, unit: str, name: str, shown: str) -> None:
    assert channel_name(title, unit) == name
    assert unit_of(name) == shown


PLAIN = "time_s,force_kn\n0.0,0.0\n0.1,1.0\n0.2,2.0\n"
RECORDS = {
    "plain": PLAIN,
    "brackets": "Time (s),Force (kN)\n0,0\n0.1,1\n0.2,2\n",
    "units in a row": '"Time","Force"\n"(s)","(kN)"\n"0","0"\n"0.1","1"\n"0.2","2"\n',
    "semicolons and commas": "Zeit [s];Force [kN]\n0,0;0,0\n0,1;1,0\n0,2;2,0\n",
    "tabs and a preamble": "Machine 7\nBy\tA. B.\n\nTime / ms\tForce / kN\tNote\n0\t0\ta\n100\t1\t\n200\t2\t\n",
    "Latin-1": "Time (s);Force (kN);Temperature (°C)\n0;0;20\n0.1;1;20\n0.2;2;20\n",
}


@pytest.mark.parametrize("form", RECORDS)
def test_a_record_is_read_in_the_forms_that_programs_write(form: str) -> None:
    table = read_channel_table(RECORDS[form].encode("latin-1" if form == "Latin-1" else "utf-8"))
    assert not table.absolute
    np.testing.assert_allclose(table.time_s, [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(table.channels["force_kn"], [0.0, 1.0, 2.0])
    assert table.interval_s == pytest.approx(0.1)


def test_times_of_the_calendar_are_in_utc_where_they_state_no_zone() -> None:
    zone = read_channel_table(b"Timestamp,Force (N)\n2026-03-01T13:00:00+01:00,1\n2026-03-01T13:00:01+01:00,2\n")
    none = read_channel_table(b"Timestamp,Force (N)\n2026-03-01 12:00:00,1\n2026-03-01 12:00:01.5,2\n")
    assert zone.absolute
    assert none.absolute
    assert zone.time_s[0] == none.time_s[0] == 1772366400.0  # date -u -d 2026-03-01T12:00:00 +%s
    assert none.time_s[1] - none.time_s[0] == 1.5


def test_a_step_gets_what_lies_on_the_line_between_readings_and_nothing_beyond_or_in_a_gap() -> None:
    table = read_channel_table(b"time_s,force_n,valve_v\n0,0,5\n1,10,\n2,20,7\n10,100,7\n")
    assert table.at(0.5, 2.0) == {"force_n": 5.0, "valve_v": 5.5}
    assert table.at(0.5, 1.0) == {"force_n": 5.0}  # the valve's readings are 2 s apart
    assert table.at(2.0, 1.0) == {"force_n": 20.0, "valve_v": 7.0}
    assert table.at(5.0, 3.0) == {}
    assert table.at(-0.1, 3.0) == {}
    assert table.at(10.1, 3.0) == {}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no table"),
        (b"a text\nof two lines\n", "no table"),
        (b"force_n,stroke_mm\n1,2\n2,3\n", "No column's title"),
        (b"1,2\n2,3\n", "no row of titles"),
        (b"time_s,force_n\n1,2\n1,3\n", "do not rise"),
        (b"time_s,remark\n1,a\n2,b\n", "no column of numbers"),
        (b"time_s,force_n\n1,2\nlater,3\n", "neither numbers"),
        (b"\xff\xfe\x00\x01" * 50, "no table"),
    ],
)
def test_what_is_no_record_is_refused_with_the_reason(content: bytes, said: str) -> None:
    with pytest.raises(StereorigError) as refused:
        read_channel_table(content)
    assert refused.value.code == "channels_unreadable"
    assert said in refused.value.cause


def test_the_column_of_times_can_be_named() -> None:
    table = read_channel_table(b"Clock (s),Time to failure (s)\n0,9\n1,8\n", time_column="Clock")
    np.testing.assert_allclose(table.channels["time_to_failure_s"], [9.0, 8.0])
    with pytest.raises(StereorigError, match="no column 'Hour'"):
        read_channel_table(b"Clock (s),Force (N)\n0,9\n1,8\n", time_column="Hour")
