"""Stereo digital image correlation (3-D DIC) in Python: calibrations, shape, motion, strain, gauges.

>>> import stereorig as dic                                                                # doctest: +SKIP
>>> calibration = dic.read_calibration("calibration.json")                                 # doctest: +SKIP
>>> left, right = dic.read_image("left_0.tif"), dic.read_image("right_0.tif")              # doctest: +SKIP
>>> test = dic.Measurement(calibration, left, right, roi=(90, 80, 420, 400), subset_px=33)  # doctest: +SKIP
>>> step = test.displacement(dic.read_image("left_1.tif"), dic.read_image("right_1.tif"))  # doctest: +SKIP
>>> step.dataset["w_mm"].plot()                                                            # doctest: +SKIP

Lengths are mm in the system frame of the calibration, image coordinates px with pixel centres at integers. A point that
failed has NaN and a `status`; every value has its standard uncertainty (`sigma_*`, k = 1), and
``Result.uncertainty_includes`` names its parts: the calibration's part is missing if its covariance is not known.

:class:`stereorig.Client` and :class:`stereorig.AsyncClient` drive a running service instead: rig, tests, results.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Where a checkout or a copy of it made files of the links to the packages, they are found beside this one
if (Path(__file__).parent / "core").is_file():
    __path__.append(str(Path(__file__).parents[1]))

if TYPE_CHECKING:
    from stereorig.calibration import calibrate, read_calibration
    from stereorig.client import AsyncClient, Client
    from stereorig.core.errors import StereorigError
    from stereorig.core.gauge.area import AreaStatistics
    from stereorig.core.gauge.extensometer import Extensometer
    from stereorig.core.gauge.reading import Reading
    from stereorig.core.gauge.rigid import RigidMotion
    from stereorig.core.settings import AnalysisSettings, Region, StrainSettings
    from stereorig.core.status import PointStatus
    from stereorig.measurement import Measurement
    from stereorig.result import Result, read_result
    from stereorig.server.evaluations.door import Evaluated, Evaluation, GridValues, Results
    from stereorig.server.formats.calibrations.recognise import LoadedCalibration as Calibration
    from stereorig.server.formats.images import read_image
    from stereorig.server.formats.noise_json import LoadedNoise as Noise
    from stereorig.server.formats.noise_json import load_noise as read_noise

    __version__: str

#: module of each name; it is imported when the name is first used
_LIES_IN = {
    "AnalysisSettings": "stereorig.core.settings",
    "AreaStatistics": "stereorig.core.gauge.area",
    "AsyncClient": "stereorig.client",
    "Calibration": "stereorig.server.formats.calibrations.recognise:LoadedCalibration",
    "Client": "stereorig.client",
    "Evaluated": "stereorig.server.evaluations.door",
    "Evaluation": "stereorig.server.evaluations.door",
    "Extensometer": "stereorig.core.gauge.extensometer",
    "GridValues": "stereorig.server.evaluations.door",
    "Measurement": "stereorig.measurement",
    "Noise": "stereorig.server.formats.noise_json:LoadedNoise",
    "PointStatus": "stereorig.core.status",
    "Reading": "stereorig.core.gauge.reading",
    "Region": "stereorig.core.settings",
    "Result": "stereorig.result",
    "Results": "stereorig.server.evaluations.door",
    "RigidMotion": "stereorig.core.gauge.rigid",
    "StereorigError": "stereorig.core.errors",
    "StrainSettings": "stereorig.core.settings",
    "calibrate": "stereorig.calibration",
    "read_calibration": "stereorig.calibration",
    "read_image": "stereorig.server.formats.images",
    "read_noise": "stereorig.server.formats.noise_json:load_noise",
    "read_result": "stereorig.result",
}

__all__ = [
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
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from stereorig.server.formats.version import software_version

        value: Any = software_version()
    elif name in _LIES_IN:
        module, _, original = _LIES_IN[name].partition(":")
        value = getattr(importlib.import_module(module), original or name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
