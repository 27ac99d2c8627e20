"""Packages that describe things and work on them: their descriptions load without what works."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from tests.support.requirements import ROOT


@pytest.mark.parametrize("name", ["boards", "calibration", "grid", "matching", "orientation", "strain"])
def test_every_name_is_found_where_it_lies(name):
    name = f"stereorig.core.{name}"
    package = importlib.import_module(name)
    assert dir(package) == sorted(package.__all__)
    for one in package.__all__:
        assert getattr(package, one) is not None
    with pytest.raises(AttributeError, match=f"'{name}' has no attribute 'nothing'"):
        package.nothing  # noqa: B018 - the attribute's absence is what is asked for


def test_measuring_loads_nothing_that_finds_targets():
    code = (
        "import sys, stereorig.server.cli.measurement.measure, stereorig.server.compute.sequence; print(*sys.modules)"
    )
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "stereorig.core.boards.board" in loaded.split()
    late = {"boards.detect", "grid.detect", "calibration.solve"}
    assert not {f"stereorig.core.{name}" for name in late} & set(loaded.split())
