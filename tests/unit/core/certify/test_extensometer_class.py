"""The class of an extensometer: limits of ISO 9513 worked out by hand."""

from __future__ import annotations

import pytest

from stereorig.core.certify.evidence import ExtensometerPoint, ExtensometerRun
from stereorig.core.certify.extensometer_class import extensometer_class
from stereorig.core.certify.noise_floor import independent_values


def run(error: float = 0.0, offset_mm: float = 0.0, u_mm: float = 1e-5, **more: object) -> ExtensometerRun:
    points = tuple(ExtensometerPoint(n, 0.1 * n, u_mm, 0.1 * n * (1.0 + error) + offset_mm, 1e-4) for n in range(1, 11))
    return ExtensometerRun(points, static_mm=(0.0, 2e-4), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("error", "offset_mm", "reached"),
    [
        (0.0, 0.0, "0.2"),
        (0.0, 5.9e-4, "0.2"),  # 0.6 um are permitted where 0.2 % are less
        (0.0, 6.1e-4, "0.5"),
        (1.9e-3, 0.0, "0.2"),
        (2.1e-3, 0.0, "0.5"),
        (4.9e-3, 0.0, "0.5"),
        (9.9e-3, 0.0, "1"),
        (-1.99e-2, 0.0, "2"),
        (2.1e-2, 0.0, None),
        (0.0, 7e-3, None),
    ],
)
def test_the_class_is_the_finest_whose_limits_all_readings_keep(
    error: float, offset_mm: float, reached: str | None
) -> None:
    assert extensometer_class(run(error, offset_mm)).reached == reached


#: class; error and gauge length in percent; error in um; resolution in percent and um: as in docs/explanation
TABLE = (
    ("0.2", 0.2, 0.6, 0.1, 0.2),
    ("0.5", 0.5, 1.5, 0.25, 0.5),
    ("1", 1.0, 3.0, 0.5, 1.0),
    ("2", 2.0, 6.0, 1.0, 2.0),
)
COARSER = {"0.2": "0.5", "0.5": "1", "1": "2", "2": None}
INSIDE, BEYOND = 0.999, 1.001


def reached_by(
    true_mm: float = 1.0, error_mm: float = 0.0, resolution_mm: float = 0.0, gauge_length: float = 0.0
) -> str | None:
    """The class of readings of one elongation, with one error, one resolution and one error of the gauge length."""
    points = tuple(ExtensometerPoint(n, true_mm, 1e-5, true_mm + error_mm, 1e-4) for n in range(10))
    static = (-resolution_mm, resolution_mm)  # half their range
    length = 25.0 * (1.0 + gauge_length)
    return extensometer_class(ExtensometerRun(points, static, length, 25.0)).reached


@pytest.mark.parametrize(("name", "percent", "micron", "of_reading", "resolution_um"), TABLE)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_class_ends_at_each_of_its_limits(
    name: str, percent: float, micron: float, of_reading: float, resolution_um: float, sign: float
) -> None:
    # 1 mm: the percentage is the larger limit; 0.1 mm: the micrometres are
    limits = (
        lambda by: reached_by(1.0, error_mm=sign * by * 0.01 * percent),
        lambda by: reached_by(0.1, error_mm=sign * by * 1e-3 * micron),
        lambda by: reached_by(1.0, resolution_mm=by * 0.01 * of_reading),
        lambda by: reached_by(0.1, resolution_mm=by * 1e-3 * resolution_um),
        lambda by: reached_by(1.0, gauge_length=sign * by * 0.01 * percent),
    )
    assert [limit(INSIDE) for limit in limits] == [name] * 5
    assert [limit(BEYOND) for limit in limits] == [COARSER[name]] * 5


@pytest.mark.parametrize(("name", "percent", "micron", "of_reading", "resolution_um"), TABLE)
def test_percents_and_micrometres_meet_at_one_elongation_in_every_class(
    name: str, percent: float, micron: float, of_reading: float, resolution_um: float
) -> None:
    # published for class 0.5: 3 times 0.5 um below 300 um, 0.5 % above
    assert 1e-3 * micron / (0.01 * percent) == pytest.approx(0.3)
    assert 1e-3 * resolution_um / (0.01 * of_reading) == pytest.approx(0.2)
    for true_mm, error_mm in ((0.299, 1e-3 * micron), (0.301, 0.301 * 0.01 * percent)):
        assert reached_by(true_mm, error_mm=INSIDE * error_mm) == name
        assert reached_by(true_mm, error_mm=BEYOND * error_mm) == COARSER[name]


def test_resolution_and_gauge_length_count_too() -> None:
    coarse = ExtensometerRun(run().points, static_mm=(-1.1e-3, 1.1e-3))  # 1.1 um; of 0.1 mm class 2 permits 2 um
    assert extensometer_class(coarse).reached == "2"
    assert extensometer_class(run(gauge_length_mm=25.2, known_gauge_length_mm=25.0)).reached == "1"
    assert extensometer_class(run(gauge_length_mm=26.0, known_gauge_length_mm=25.0)).reached is None


def test_a_reference_that_is_too_coarse_is_told() -> None:
    found = extensometer_class(run(u_mm=3e-4, gauge_length_mm=25.0, known_gauge_length_mm=25.0))
    assert found.reached == "0.2"
    assert found.reference_fit == "1"  # 2 u = 0.6 um; a third of 3 um is permitted
    assert any("third" in note for note in found.notes)
    assert not extensometer_class(run(gauge_length_mm=25.0, known_gauge_length_mm=25.0)).notes


def test_overlapping_windows_count_for_less() -> None:
    assert independent_values(100, 20.0, 20.0) == 100.0
    # half of a window shared with each of two neighbours: 1 + 2 / 4 along each axis
    assert independent_values(100, 10.0, 20.0) == pytest.approx(100.0 / 1.5**2)
