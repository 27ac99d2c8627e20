"""Readers of foreign files under coverage-guided fuzzing: coded errors alone, nothing opened, memory bounded."""

from __future__ import annotations

import importlib.util

import pytest

from tests.fuzz.readers import run

NAMES = ("image", "mask", "opencv", "dice_xml", "vic3d", "caldat", "pyvale", "dice_txt", "native", "channels", "vtu")
NAMES += ("xdmf", "heavy", "table", "manifest", "result")


@pytest.mark.fault(52)
@pytest.mark.fault(56)
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not there for this Python")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "executions", [2000, pytest.param(1_000_000, marks=[pytest.mark.deep, pytest.mark.timeout(14_400)])]
)
def test_a_reader_ends_in_an_answer_or_a_coded_error(name: str, executions: int) -> None:
    code, _, said = run(name, executions, seed=executions)
    assert code == 0, said[-3000:]
    assert f"stat::number_of_executed_units: {executions}" in said
