"""A load frame's record is read whole in any maker's form, or what it leaves open is asked; nothing goes in silence."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereorig.core.errors import StereorigError
from stereorig.server.formats.channel_table import read_channel_table, read_record
from stereorig.server.formats.channel_units import FORCE_N
from stereorig.server.formats.load_frames.description import RecordOptions
from tests.support.written_records import FOOTERS, HEADS, NEWTONS, NOTATIONS, TIMES, Form, forms, written

pytestmark = pytest.mark.fault(64)
#: a force of 50 N/s, an extension of 0.01 mm/s: as long as a short test, over 1000 N
ROWS = [(0.5 * k, 25.0 * k, 0.005 * k) for k in range(91)]


def check(form: Form, rows: list[tuple[float, float, float]] = ROWS) -> None:
    table, read = read_record(written(form, rows))
    assert table is not None, (form, read.questions)
    assert read.questions == [], form
    assert table.time_s.size == len(rows), (form, read)
    forces = [name for name, unit in table.units.items() if unit == form.force]
    assert len(forces) == 1, (form, table.units)
    time, force, extension = (np.array(column) for column in zip(*rows, strict=True))
    np.testing.assert_allclose(table.time_s, time, atol=1e-3)
    newtons = FORCE_N[table.units[forces[0]]] * table.channels[forces[0]]
    np.testing.assert_allclose(newtons, force, atol=1e-3 * max(1.0, NEWTONS[form.force]))
    (other,) = table.channels.keys() - forces
    np.testing.assert_allclose(table.channels[other], extension, atol=1e-5)
    assert table.units[other] == "mm"
    assert sum(map(len, table.unread.values())) == 0
    # every line is a reading, the titles, the units or counted
    lines = sum(bool(line.strip()) for line in written(form, rows).decode(form.encoding).splitlines())
    heads = 2 if form.units.startswith("row") else 1
    assert len(rows) + heads + read.left_above + read.left_between + read.left_below == lines, (form, read)


@pytest.mark.parametrize("seed", range(10))
def test_a_record_of_any_form_is_read_whole(seed: int) -> None:
    for form in forms(60, seed):
        check(form)


def test_each_head_goes_with_each_footer_and_notation() -> None:
    for head, footer, (separator, decimal, group) in itertools.product(HEADS, FOOTERS, NOTATIONS):
        check(Form(head=head, footer=footer, separator=separator, decimal=decimal, group=group, units="row"))


@pytest.mark.parametrize("language", TIMES)
def test_the_times_column_is_known_in_the_languages_of_the_machines(language: str) -> None:
    for time in TIMES[language]:
        check(Form(language=language, time=time, encoding="utf-8"))


@pytest.mark.parametrize(
    "unit", ["N", "kN", "MN", "mN", "cN", "daN", "lbf", "kip", "kgf", "in", "ft", "nm", "um", "Nm"]
)
def test_a_unit_is_the_files(unit: str) -> None:
    table = read_channel_table(f"Time (s),A ({unit})\n0.5,1\n1.5,2\n".encode())
    assert list(table.units.values()) == [{"Nm": "N m"}.get(unit, unit)]


@pytest.mark.parametrize(
    ("unit", "shown"),
    [
        ("psi", "psi"),
        ("ksi", "ksi"),
        ("°F", "degF"),
        ("degF", "degF"),
        ("µm", "um"),
        ("N·m", "N m"),
        ("furlong", "furlong"),
        ("m·N", "N m"),
        ("mN.", "mN"),
        ("Newtons", "N"),
        ("kilonewton", "kN"),
        ("pound-force", "lbf"),
        ("Н", "N"),
        ("Zoll", "in"),
    ],
)
def test_an_unknown_unit_is_shown_as_written_and_a_known_one_in_one_spelling(unit: str, shown: str) -> None:
    table = read_channel_table(f"Time;A\ns;{unit}\n0,5;1\n1,5;2\n".encode())
    assert list(table.units.values()) == [shown]


@pytest.mark.parametrize(
    ("title", "unit"), [("A (N) [Ch 2]", "N"), ("A (N) [x1000]", "x1000"), ("A (N) [milli]", "milli")]
)
def test_a_channel_behind_a_unit_leaves_it_and_a_factor_does_not(title: str, unit: str) -> None:
    table = read_channel_table(f"Time (s),{title}\n0.5,1\n1.5,2\n".encode())
    assert list(table.units.values()) == [unit]


# files in the manner of makers' own programs: lines above the rows, a row's form, encoding, what is asked; a row's
# time in s, force in N and stroke in mm, the force as daN, kN, lbf and kgf, the number, the stroke in inches
MAKERS: dict[str, tuple[str, str, str, str]] = {
    "Bluehill": (
        'Results Table 1\n"","Label","Maximum Load (N)"\n"1","P-07","2250.000"\n"Mean","","2250.000"\n\nRaw Data\n'
        '"Time","Extension","Load"\n"(sec)","(mm)","(kN)"\n',
        '"{0:.3f}","{2:.4f}","{4:.6f}"',
        "utf-8-sig",
        "",
    ),
    "testXpert": (
        "Prüfer\tMüller\nDatum\t01.03.2026\nFmax\t2250,0\tN\n\nPrüfzeit\tStandardkraft\tStandardweg\ns\tN\tmm\n",
        "{0:,.3f}\t{1:,.2f}\t{2:,.4f}",
        "cp1252",
        "",
    ),
    "testXpert, units within titles": (
        "Zeit in s;Standardkraft in N;Weg in mm\n",
        "{0:,.3f};{1:,.2f};{2:,.4f}",
        "utf-8",
        "",
    ),
    "testXpert, units above titles": ("s;N;mm\nZeit;Kraft;Weg\n", "{0:,.3f};{1:,.2f};{2:,.4f}", "utf-8", ""),
    "TestSuite": (
        "Name: P-07 03.01.2026 12 00\nSpecimen:\tP-07\n\nTime \tAxial Displacement \tAxial Force \nsec\tmm\tkN\n",
        "{0:.4f}\t{2:.5f}\t{4:.6f}",
        "utf-8",
        "",
    ),
    "Insight": ('"Specimen 1"\n"Crosshead ","Load ","Time "\n"mm","N","s"\n', "{2:.4f},{1:.4f},{0:.3f}", "utf-8", ""),
    "Trapezium": (
        '"Key Word","","Product Name","",""\n"Report Date","2026/03/01"\n"Test Speed","5mm/min"\n\n"1 _ 1"\n'
        '"時間","試験力","ストローク"\n"sec","N","mm"\n',
        "{0:.2f},{1:.3f},{2:.5f}",
        "cp932",
        "",
    ),
    "Trapezium, two specimens": (
        '"Time","Force","Time","Stroke"\n"sec","N","sec","mm"\n',
        "{0:.2f},{1:.3f},{7:.2f},{2:.5f}",
        "utf-8",
        "time_column",
    ),
    "WaveMatrix": (
        "Total Time (s),Cycle Elapsed Time (s),Total Cycles,Position(Linear:Position) (mm),Load(Linear:Load) (kN)\n",
        "{0:.3f},{8:.3f},1,{2:.5f},{4:.6f}",
        "utf-8",
        "",
    ),
    "Horizon": ("Test\tP-07\nTime (Sec)\tForce (lbf)\tPosition (in)\n", "{0:.3f}\t{5:.7f}\t{9:.7f}", "utf-16", ""),
    "Nexygen": (
        "Batch,B-1,\nDate,01/03/2026,\nTime (s), Load (N), Extension (mm),\n",
        "{0}, {1:.3f}, {2:.4f},",
        "utf-8",
        "",
    ),
    "catman": (
        "catman/AP\nDATEI: p07\n\nZeit  1 - Messrate [s]\tKraft [kN]\tWeg [mm]\nRate 2 Hz\tRate 2 Hz\t2 Hz\n",
        "{0:,.3f}\t{4:,.6f}\t{2:,.4f}",
        "utf-8",
        "",
    ),
    "LabVIEW": (
        "LabVIEW\t\nDate\t2026/03/01\nTime\t12:00:00.0\n***End_of_Header***\t\nX_Value\tForce (N)\tStroke (mm)\n",
        "{0:.6f}\t{1:.6f}\t{2:.6f}",
        "utf-8",
        "time_column",
    ),
    "dates and clock times": ("Date;Time;Load (N)\n", "01/03/2026;12:00:{0:04.1f};{1:.2f}", "utf-8", "date_order"),
    "Ibertest": ("Ensayo nº 12\nTiempo (s);Fuerza (daN);Posición (mm)\n", "{0:,.1f};{3:,.4f};{2:,.4f}", "cp1252", ""),
    "EMIC": ('"Tempo (s)";"Força (kgf)";"Curso (mm)"\n', '"{0:,.1f}";"{6:,.6f}";"{2:,.4f}"', "cp1252", ""),
    "catman, a head of as many words": (
        "Start: 01.03.2026 12:00:00\nZeit  1 - Messrate\tKraft\tWeg\ns\tkN\tmm\nRate: 2.0 Hz\tRate: 2.0 Hz\t2.0 Hz\n",
        "{0:,.3f}\t{4:,.6f}\t{2:,.4f}",
        "cp1252",
        "",
    ),
    "quotes and blanks": ('"Testzeit" "Kraft" "Weg"\n"s" "N" "mm"\n', "{0:.3E} {1:.6E} {2:.6E}", "utf-8", ""),
    "titles of two lines": (
        'Breite;2" (nominal)\n"Time\n(s)";"Force\n(N)";"Stroke\n(mm)"\n',
        "{0:.3f};{1:.3f};{2:.4f}",
        "utf-8",
        "",
    ),
    "Cyrillic units": ("Время, с;Нагрузка, кН;Перемещение, мм\n", "{0:,.3f};{4:,.6f};{2:,.4f}", "cp1251", ""),
    "bars": ("Zeitpunkt|Force (N)|Stroke (mm)\n", "{0:.3f}|{1:.3f}|{2:.4f}", "utf-8", ""),
    "channels behind units": ("Time (s) [Ch 1];Force (kN) [Ch 2]\n", "{0:.3f};{4:.6f}", "utf-8", ""),
    "blanks alone": ("Time Load Ext\ns N mm\n", "{0:.3f} {1:.3f} {2:.4f}", "utf-8", ""),
}
CHOICES = {"time_column": "1", "date_order": "dmy"}


@pytest.mark.parametrize("maker", MAKERS)
def test_a_file_in_the_manner_of_a_makers_program_is_read_or_asked_about(maker: str) -> None:
    head, form, encoding, question = MAKERS[maker]
    lines = []
    for time, force, stroke in ROWS:
        values = (time, force, stroke, force / 10, force / 1e3, force / NEWTONS["lbf"], force / NEWTONS["kgf"])
        line = form.format(*values, time / 2, time % 5, stroke / 25.4)
        lines.append(line.translate(str.maketrans(",.", ".,")) if ":,." in form else line)
    content = (head + "\n".join(lines)).encode(encoding)
    assert [one.option for one in read_record(content)[1].questions] == [question] * bool(question)
    table = read_channel_table(content, **({question: CHOICES[question]} if question else {}))
    (name,) = (name for name, unit in table.units.items() if unit in FORCE_N)
    time, force, _ = (np.array(column) for column in zip(*ROWS, strict=True))
    np.testing.assert_allclose(table.time_s - table.time_s[0], time, atol=1e-6)
    np.testing.assert_allclose(FORCE_N[table.units[name]] * table.channels[name], force, atol=0.01)


# what is not sure -----------------------------------------------------------------------------------------------------


def asked(text: str, **given: object) -> list[str]:
    return [one.option for one in read_record(text.encode(), RecordOptions(**given))[1].questions]  # type: ignore[arg-type]


def test_numbers_that_have_two_values_are_asked_about_and_the_answer_decides() -> None:
    text = "Time (s);Force (N)\n1;1,025\n2;1,050\n3;1,075\n"
    assert asked(text) == ["decimal"]
    with pytest.raises(StereorigError, match="decides it") as refused:
        read_channel_table(text.encode())
    assert refused.value.code == "channels_unsure"
    assert "--decimal" in refused.value.remedy
    point, comma = (read_channel_table(text.encode(), decimal=mark).channels["force_n"] for mark in (".", ","))
    np.testing.assert_allclose(point, [1025.0, 1050.0, 1075.0])
    np.testing.assert_allclose(comma, [1.025, 1.05, 1.075])
    # another column of the file decides
    other = (
        text.replace("s)", "s);x").replace("\n1;", "\n1;0,5;").replace("\n2;", "\n2;0,5;").replace("\n3;", "\n3;0,5;")
    )
    np.testing.assert_allclose(read_channel_table(other.encode()).channels["force_n"], [1.025, 1.05, 1.075])


def test_segments_of_a_clock_that_restarts_are_asked_about_and_kept_apart() -> None:
    first, second = ("".join(f"{t / 2},{f + t}\n" for t in range(5)) for f in (0, 9000))
    text = f"Time (s),Force (N)\n{first}\nTime (s),Force (N)\n{second}"
    assert asked(text) == ["segment"]
    for segment, force in ((1, 0.0), (2, 9000.0)):
        table = read_channel_table(text.encode(), segment=segment)
        np.testing.assert_allclose(table.channels["force_n"], force + np.arange(5))
    read = read_record(text.encode())[1]
    assert [(one.first_line, one.last_line, one.readings) for one in read.segments] == [(2, 6, 5), (9, 13, 5)]
    with pytest.raises(StereorigError, match="no segment 3"):
        read_channel_table(text.encode(), segment=3)


@pytest.mark.parametrize(
    ("footer", "asks"),
    [
        ("\n45.0,2250.0,0.45\n", True),  # a row of maxima below a blank line
        ("\n45.2,2250.1,0.46\n", True),
        ("2070.0,1125.0,0.225\n", True),  # a sum of times, means
        ("91,91,91\n", True),  # their number
        ("\n60,2250.0,0.45\n60.5,0,0\n70,1,1\n", True),
        ("45.5,2275,0.455\n", False),  # the next reading
        ("50,2275,0.455\n55.5,2280,0.46\n", False),  # after some seconds
    ],
)
def test_a_footer_of_numbers_alone_is_asked_about(footer: str, asks: bool) -> None:
    """91 readings each half second: what follows them is no reading for sure if it lies apart in lines or in time."""
    rows = "".join(f"{t},{f},{x}\n" for t, f, x in ROWS)
    text = f"Time (s),Force (N),X (mm)\n{rows}{footer}".encode()
    table, read = read_record(text)
    assert [one.option for one in read.questions] == ["segment"] * asks
    if asks:
        assert read.questions[0].choices == ["1", "2", "0"]
        assert "may be a footer's" in read.questions[0].cause
        assert read_channel_table(text, segment=1).time_s.size == len(ROWS)
    everything = read_channel_table(text, segment=0) if asks else table
    assert everything is not None
    same = footer.startswith("\n45.0")  # no second reading at one time
    assert everything.time_s.size == len(ROWS) + len(footer.split()) - same


def test_readings_in_blocks_or_of_a_changing_rate_are_no_footer() -> None:
    blocks = [f"{5 * k},{k}\n{5 * k + 1},{k}\n\n" for k in range(20)]
    rates = [f"{t:.4f},{t:.4f}\n" for t in np.geomspace(0.1, 1e4, 40)]
    for rows in (blocks, rates):
        table, read = read_record(f"Time (s),Force (N)\n{''.join(rows)}".encode())
        assert read.questions == []
        assert table is not None
        assert table.time_s.size == 40


def test_two_tables_are_not_joined() -> None:
    rows = "".join(f"{t},{t},0.5\n" for t in range(20))
    with pytest.raises(StereorigError, match="two tables"):
        read_channel_table(f"Time (s),Force (N),X (mm)\n{rows}Time (s),X (mm),Force (N)\n{rows}".encode())


def test_columns_that_may_all_be_the_time_are_asked_about() -> None:
    text = "Time of machine (s),Time of logger (s),F (N)\n0.5,10.5,1\n1.5,11.5,2\n"
    assert asked(text) == ["time_column"]
    np.testing.assert_allclose(read_channel_table(text.encode(), time_column="2").time_s, [10.5, 11.5])
    # one of them falls, and cannot be it
    assert asked(text.replace("11.5", "9.5")) == []
    # without a word for it, the one column in a unit of time that never falls
    table = read_channel_table(b"Verlauf [ms],F [N]\n500,1\n1500,2\n")
    np.testing.assert_allclose(table.time_s, [0.5, 1.5])


def test_unquoted_commas_within_and_between_numbers_are_refused() -> None:
    grouped = "Time (s),Force (N)\n" + "".join(f"{t}.5,{f}\n" for t, f in enumerate(["950.0", "975.0", "1,000.0"]))
    decimal = "Time (s),Force (N)\n0,5,25,0\n1,0,50,0\n1,5,75,0\n"
    for text in (grouped, decimal):
        with pytest.raises(StereorigError) as refused:
            read_channel_table(text.encode())
        assert "commas" in f"{refused.value.cause} {refused.value.remedy}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # trailing separators have as many cells as commas within thousands
        ("Time (s),Force (N),x (mm),\n" + "".join(f"{t}.5,2,{t}50,0.1\n" for t in range(1, 9)), "parts of numbers"),
        ("Time, s,Force, N\n" + "".join(f"{t},5,{t}0,25\n" for t in range(1, 9)), "parts of numbers"),
        ("Time,Force (N)\n46082.5000,1\n46082.5001,2\n", "days of a spreadsheet"),
        ("Timestamp,Force (N)\n1772366400000,1\n1772366400500,2\n", "milliseconds"),
        ("PK\3\4 and more", "workbook"),
    ],
)
def test_numbers_that_would_be_others_are_refused_with_their_likely_meaning(text: str, said: str) -> None:
    with pytest.raises(StereorigError, match=said) as refused:
        read_channel_table(text.encode())
    assert refused.value.code == "channels_unreadable"


def test_a_cell_that_cannot_be_read_is_counted_and_no_step_bridges_it() -> None:
    text = "Time (s);Force (N)\n0,5;1\n1,0;2\n1,5;OVER\n2,0;4\n2,5;5\n"
    table, read = read_record(text.encode())
    assert table is not None
    (force,) = [one for one in read.columns if one.name == "force_n"]
    assert (force.numbers, force.unread, force.empty) == (4, 1, 0)
    assert any("'OVER' in line 4" in doubt for doubt in read.doubts)
    assert table.at(1.5, 10.0) == table.at(1.2, 10.0) == {}
    assert table.at(1.0, 10.0) == {"force_n": 2.0}
    assert table.at(2.2, 10.0) == {"force_n": pytest.approx(4.4)}
    # an empty cell is no reading, and is bridged
    assert read_channel_table(text.replace("OVER", "").encode()).at(1.5, 10.0) == {"force_n": 3.0}


def test_a_row_of_another_width_is_counted_and_no_step_bridges_it() -> None:
    table, read = read_record(b"t;F (N);x\n0.5;1;1\n1.0;2\n1.5;3;1\n2.0;4;1\n")
    assert table is not None
    assert read.left_between == 1
    assert any("line 3 has 2" in doubt for doubt in read.doubts)
    assert "f_n" not in table.at(1.0, 10.0)
    assert table.at(1.75, 10.0)["f_n"] == 3.5


# clocks and dates -----------------------------------------------------------------------------------------------------

NOON = 1772366400.0  # date -u -d 2026-03-01T12:00:00 +%s


@pytest.mark.parametrize(
    ("titles", "cells", "expected", "given"),
    [
        ("Time", ["00:00:01.5", "00:01:02"], [1.5, 62.0], {}),
        ("Time [hh:mm:ss]", ["12:00:01", "12:00:02"], [43201.0, 43202.0], {}),
        ("Time (mm:ss)", ["01:30", "01:31"], [90.0, 91.0], {}),
        ("Uhrzeit", ["00:00:01,25", "00:00:02,25"], [1.25, 2.25], {}),
        ("Zeit", ["01.03.2026 12:00:00,5", "01.03.2026 12:00:01,5"], [NOON + 0.5, NOON + 1.5], {}),
        ("Timestamp", ["2026/03/01 12:00:00", "2026/03/01 12:00:01"], [NOON, NOON + 1.0], {}),
        ("Timestamp", ["03/01/2026 12:00:00 PM", "03/01/2026 12:00:01 PM"], [NOON, NOON + 1.0], {"date_order": "mdy"}),
        ("Timestamp", ["01-Mar-2026 12:00:00", "01-Mar-2026 12:00:01"], [NOON, NOON + 1.0], {}),
        ("Timestamp", ["1. Mrz 2026 12:00:00,5", "1. Mrz 2026 12:00:01,5"], [NOON + 0.5, NOON + 1.5], {}),
        ("Timestamp", ["2026-03-01 14:00:00 +0200", "2026-03-01 12:00:01 UTC"], [NOON, NOON + 1.0], {}),
        ("Uhrzeit", ["23:59:59,5", "00:00:00,5"], [86399.5, 86400.5], {}),
        ("Datum;Uhrzeit", ["01.03.2026;12:00:00", "01.03.2026;12:00:01"], [NOON, NOON + 1.0], {}),
    ],
)
def test_clock_times_and_dates_are_read(
    titles: str, cells: list[str], expected: list[float], given: dict[str, str]
) -> None:
    text = f"{titles};F (N)\n" + "".join(f"{cell};{k}\n" for k, cell in enumerate(cells))
    table = read_channel_table(text.encode(), **given)
    np.testing.assert_allclose(table.time_s, expected, atol=1e-6)
    assert table.absolute == (expected[0] > 1e9)
    assert list(table.channels) == ["f_n"]


def test_dates_that_begin_with_day_or_month_are_asked_about() -> None:
    text = "Time;F (N)\n03/01/2026 12:00:00;1\n03/01/2026 12:00:01;2\n"
    assert asked(text) == ["date_order"]
    assert asked(text.replace("03/01", "13/01")) == []


def test_readings_that_share_a_time_are_counted() -> None:
    table, read = read_record(b"Time;F (N)\n00:00:01;1\n00:00:01;2\n00:00:02;3\n")
    assert table is not None
    assert table.time_s.size == 2
    assert any("the time of the one before: 1" in doubt for doubt in read.doubts)


def test_a_record_from_the_last_to_the_first_is_turned() -> None:
    table, read = read_record(b"Time (s);F (N)\n2.5;3\n1.5;2\n0.5;1\n")
    assert table is not None
    np.testing.assert_allclose(table.channels["f_n"], [1.0, 2.0, 3.0])
    assert any("from the last to the first" in doubt for doubt in read.doubts)


def test_a_quote_within_a_cell_joins_no_lines() -> None:
    table = read_channel_table(b'Time (s),F (N),Note\n0.5,1,5" of,"x\n1.5,2,\n2.5,3,\n')
    np.testing.assert_allclose(table.channels["f_n"], [2.0, 3.0])
    long = "".join(f'{t}.5,{t},"{"x" * 30_000}\n' if t == 1 else f"{t}.5,{t},a\n" for t in range(9))
    assert read_channel_table(f"Time (s),F (N),Note\n{long}".encode()).time_s.size == 9
