"""The library's face: its names, what importing it costs, and what it refuses."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stereorig as dic
from tests.support.requirements import ROOT

NAMES = {
    "AnalysisSettings",
    "AreaStatistics",
    "AsyncClient",
    "Calibration",
    "Client",
    "Evaluated",
    "Evaluation",
    "Extensometer",
    "GridValues",
    "Measurement",
    "Noise",
    "PointStatus",
    "Reading",
    "Region",
    "Result",
    "Results",
    "RigidMotion",
    "StereorigError",
    "StrainSettings",
    "__version__",
    "calibrate",
    "read_calibration",
    "read_image",
    "read_noise",
    "read_result",
}


def test_the_face_has_these_names_and_each_is_there() -> None:
    assert set(dic.__all__) == NAMES
    assert dic.__all__ == sorted(dic.__all__)
    assert set(dir(dic)) == NAMES
    for name in NAMES - {"__version__"}:
        assert getattr(dic, name).__doc__, name
    with pytest.raises(AttributeError):
        dic.nothing  # noqa: B018


def test_a_copy_whose_links_became_files_is_imported_too(tmp_path: Path) -> None:
    for folder in ("stereorig", "core"):
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    link = tmp_path / "stereorig" / "core"
    link.unlink()
    link.write_text("../core")
    code = "from stereorig.core import names; print(names.__file__)"
    shown = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == str(tmp_path / "core" / "names.py")


def test_importing_it_loads_neither_service_nor_kernels() -> None:
    """Nothing is compiled, and the heavy libraries wait for their first use."""
    code = (
        "import stereorig, sys; print([m for m in sys.modules if m.split('.')[0] in ('fastapi', 'numba', 'uvicorn')])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_a_users_own_modules_named_like_its_packages_do_no_harm(tmp_path: Path) -> None:
    for name in ("core", "drivers", "server", "sim"):
        (tmp_path / f"{name}.py").write_text("raise ImportError(__name__)\n")
    code = "import stereorig; print(len([getattr(stereorig, name) for name in stereorig.__all__]))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    shown = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert shown.stdout.strip() == str(len(NAMES)), shown.stderr


def test_measuring_needs_neither_web_service_nor_devices() -> None:
    code = (
        "import stereorig, sys; [getattr(stereorig, n) for n in stereorig.__all__ if 'Client' not in n];"
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'fastapi', 'uvicorn', 'serial'}),"
        "[m for m in sys.modules if m.startswith(('stereorig.drivers', 'stereorig.sim'))],"
        "[m for m in sys.modules if m.startswith(tuple(f'stereorig.server.{n}' for n in ('worker', 'rig', 'api')))])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[] [] []"


def test_parameters_are_checked_once_and_by_the_settings() -> None:
    image = np.zeros((64, 64), np.uint8)
    with pytest.raises(dic.StereorigError) as caught:
        dic.Measurement("nowhere.json", image, image, roi=(0, 0, 60, 60))
    assert caught.value.code == "file_missing"
    with pytest.raises(ValueError, match="subset_px"):
        dic.AnalysisSettings.model_validate({"region": {"rectangle": [0, 0, 60, 60]}, "subset_px": 20})
