"""What the curves of a report are drawn against."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from stereorig.server.report import histories
from stereorig.server.report.histories import _against_temperature, _Axis


def steps(w_mm: list[float], seconds: list[float | None], **recorded: list[float | None]) -> Any:
    """Steps with a mean motion along Z; the first one is the reference."""
    loads = recorded.pop("load", [None] * len(w_mm))
    made = []
    for n, (w, s, load) in enumerate(zip(w_mm, seconds, loads, strict=True)):
        channels = {name: values[n] for name, values in recorded.items() if values[n] is not None}
        moved = {k: SimpleNamespace(mean=w if k == "w" else 0.0) for k in "uvw"} if n else None
        made.append(
            SimpleNamespace(
                n=n, seconds=s, load_n=load, channels=channels, summary=SimpleNamespace(displacement_mm=moved)
            )
        )
    return made


TIMES: list[float | None] = [0.0, 10.0, 25.0, 31.0]


def test_curves_are_drawn_against_the_pressure_that_drives_them_up_and_down() -> None:
    axis = _Axis.of(steps([0.0, 0.1, 0.2, 0.1], TIMES, pressure_kpa=[0.0, 100.0, 200.0, 100.0]))
    assert (axis.positions, axis.label) == ([0.0, 100.0, 200.0, 100.0], "pressure, kPa")
    assert axis.as_given


@pytest.mark.parametrize(
    ("w_mm", "recorded"),
    [
        ([0.0, 0.1, 0.2, 0.1], {"room_c": [20.0, 21.0, 20.5, 22.0]}),  # has nothing to do with the motion
        ([0.0, 0.1, 0.2, 0.3], {"pressure_kpa": [0.0, 100.0, None, 300.0]}),  # not known of every step
        ([0.0, 0.1, 0.2, 0.3], {"pressure_kpa": [5.0, 5.0, 5.0, 5.0]}),  # creep under a constant one
    ],
)
def test_else_they_are_drawn_against_time(w_mm: list[float], recorded: dict[str, list[float | None]]) -> None:
    axis = _Axis.of(steps(w_mm, TIMES, **recorded))
    assert (axis.positions, axis.label) == (TIMES, "time since the reference, s")


def test_the_load_comes_before_a_temperature_that_rises_with_it() -> None:
    both: Any = {"load": [0.0, 1.0, 2.0, 3.0], "air_c": [20.0, 21.0, 22.0, 23.0]}
    assert _Axis.of(steps([0.0, 0.1, 0.2, 0.3], TIMES, **both)).label == "load, N"


def test_the_epipolar_offset_is_drawn_against_each_cameras_temperature_where_it_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[tuple[list[float], Any]] = []
    monkeypatch.setattr(histories, "course", lambda x, lines, **_: drawn.append((x, lines["offset"][0])) or b"")
    degrees = {"cam1": [30.0, None, 33.0, 35.5], "cam2": [31.0, 31.0, 31.0, 31.0]}  # camera 2's does not change
    made: Any = [
        SimpleNamespace(
            n=n,
            temperature_c=lambda cam, n=n: degrees[cam][n],
            summary=SimpleNamespace(epipolar_offset_mean_px=0.01 * n),
        )
        for n in range(4)
    ]
    (picture,) = _against_temperature(made)
    assert drawn == [([30.0, 33.0, 35.5], [0.0, 0.02, 0.03])]
    assert "cam1" in picture.caption
