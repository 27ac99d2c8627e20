"""CSV that this program writes runs nothing in a spreadsheet, and keeps its numbers."""

from __future__ import annotations

import csv
import io
from types import SimpleNamespace

import pytest

from stereorig.server.formats import csv_cells
from stereorig.server.formats.gauges.readings import GaugeReadings, StepProblem, StepReadings
from stereorig.server.formats.gauges.table import gauges_csv

FORMULAS = [
    "=cmd|' /C calc'!A0",
    "+1+1",
    "-2+3",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "\n=1",
    "\uff1d1",
    "\uff0b1",
    "\uff0dx",
    "\uff20x",
]
PLAIN = ["-1.5", "+2", "-.5e-7", "steel", "a=b", "", 'odd "name"; a,b', "two\nlines", "'quoted'"]


def parted(text: str, separator: str) -> list[str]:
    return [cell for line in csv.reader(io.StringIO(text, newline=""), delimiter=separator) for cell in line]


def runs(cell: str) -> bool:
    """Return True if a spreadsheet takes a cell for a formula that is no number."""
    try:
        float(cell)
    except ValueError:
        return cell.lstrip(' "')[:1] in "=+-@\t\r\n\uff1d\uff0b\uff0d\uff20" and bool(cell.strip(' "'))
    return False


@pytest.mark.parametrize("text", FORMULAS)
def test_a_text_that_a_spreadsheet_would_run_is_written_as_text(text: str) -> None:
    assert parted(csv_cells.row([text, 1, None]), ",") == [f"'{text}", "1", ""]


@pytest.mark.parametrize("text", PLAIN)
def test_other_texts_and_all_numbers_come_back_as_they_were(text: str) -> None:
    assert parted(csv_cells.row([text, -1.25e-300, -7]), ",") == [text, "-1.25e-300", "-7"]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_comment_line_has_no_formula_however_it_is_parted(separator: str) -> None:
    line = csv_cells.comment(f'label: x{separator}{separator}=1+1{separator} "@A1{separator}+a\n-b, -1.5, -x')
    assert line.count("\n") == 1
    assert ", -1.5," in line
    assert not [cell for cell in parted(line, separator) if runs(cell)]


def test_labels_and_channels_of_a_test_run_nothing_in_the_table_of_its_gauges() -> None:
    steps = [
        StepReadings(k, "step", text, None, channels={"=1+1": -2.5}, problem=StepProblem("not_read", text, ""))
        for k, text in enumerate([*FORMULAS, *PLAIN])
    ]
    readings = GaugeReadings(
        software_version="1",
        settings={"areas": [{"name": "x,=1+1"}]},
        calibration={},
        inputs_sha256={},
        stale=False,
        stale_reasons=[],
        frame="system",
        subset_px=21.0,
        smoothing_window=None,
        alignment=None,
        statement=SimpleNamespace(document=dict),  # type: ignore[arg-type]
        steps=steps,
    )
    table = gauges_csv(readings).decode()
    assert not [cell for cell in parted(table, ",") if runs(cell)]
    assert table.splitlines()[-1].endswith(",-2.5")
