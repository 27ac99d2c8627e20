"""Numbers, names, logos and sections of a report."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereorig.core.errors import FileFormatError, InputError
from stereorig.server.formats.channel_units import channel_title
from stereorig.server.report.items import rounded, shown_unit
from stereorig.server.report.page import kept_logo, read_logo
from stereorig.server.report.task import SECTIONS, chosen_sections


@pytest.mark.parametrize(
    ("value", "u", "text"),
    [
        (0.000728778e6, 1.4e-5 * 1e6, "729 \u00b1 14"),
        (1.23456, 0.0949, "1.235 \u00b1 0.095"),
        (1.23456, 0.0999, "1.23 \u00b1 0.10"),
        (-52039.4, 123.0, "\u221252\u202f040 \u00b1 120"),
        (-0.0001, 0.2, "0.00 \u00b1 0.20"),
        (12.3456, None, "12.35"),
        (0.0, None, "0"),
    ],
)
def test_a_value_has_two_digits_of_its_uncertainty(value: float, u: float | None, text: str) -> None:
    assert rounded(value, u) == text


@pytest.mark.parametrize(
    ("units", "size", "strain", "shown"),
    [
        ("mm", 0.0999, False, (1e3, "\u00b5m")),
        ("mm", 0.1, False, (1.0, "mm")),
        ("1", 0.00999, True, (1e6, "\u00b5m/m")),
        ("1", 0.01, True, (100.0, "%")),
        ("1", 5.0, False, (1.0, "")),
    ],
)
def test_units_change_where_the_pages_do(units: str, size: float, strain: bool, shown: tuple[float, str]) -> None:
    assert shown_unit(units, size, strain=strain) == shown


@pytest.mark.parametrize(
    ("name", "unit", "title"),
    [
        ("pressure_kpa", None, "pressure, kPa"),
        ("pressure_kpa", "kPa", "pressure, kPa"),
        ("cell_1_um_m", None, "cell 1, um/m"),
        ("Force", "kN", "Force, kN"),
        ("stage_kpa", "MPa", "stage kpa, MPa"),
        ("count", None, "count"),
    ],
)
def test_a_channel_is_titled_by_its_name_and_unit(name: str, unit: str | None, title: str) -> None:
    assert channel_title(name, unit) == title


def test_sections_come_in_the_order_of_the_page() -> None:
    assert chosen_sections(["annex", "fields"]) == ("fields", "annex")
    assert chosen_sections(list(SECTIONS)) == tuple(SECTIONS)
    for wrong in (["fields", "nonsense"], []):
        with pytest.raises(InputError):
            chosen_sections(wrong)


def test_a_logo_is_a_small_picture(tmp_path: Path) -> None:
    test = tmp_path / "tests" / "t1"
    test.mkdir(parents=True)
    assert kept_logo(test) is None
    (tmp_path / "report_logo.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    assert kept_logo(test) == tmp_path / "report_logo.jpg"
    assert read_logo(tmp_path / "report_logo.jpg").media_type == "image/jpeg"
    for content in (b"GIF89a", b"\x89PNG\r\n\x1a\n" + b"\0" * (1 << 20), b"<html>"):
        (tmp_path / "other").write_bytes(content)
        with pytest.raises(FileFormatError):
            read_logo(tmp_path / "other")
