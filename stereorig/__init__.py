"""Stereo digital image correlation (3-D DIC) in Python: calibrations, shape, motion, strain, gauges.

>>> import stereorig as dic                                                                # doctest: +SKIP
>>> calibration = dic.read_calibration("calibration.json")                                 # doctest: +SKIP
>>> left, right = dic.read_image("left_0.tif"), dic.read_image("right_0.tif")              # doctest: +SKIP
>>> test = dic.Measurement(calibration, left, right, roi=(90, 80, 420, 400), subset_px=33)  # doctest: +SKIP
>>> step = test.displacement(dic.read_image("left_1.tif"), dic.read_image("right_1.tif"))  # doctest: +SKIP
>>> step.dataset["w_mm"].plot()                                                            # doctest: +SKIP

Lengths are mm in the system frame of the calibration, image coordinates px with pixel centres at integers. A point that
failed has NaN and a `status`; every value has a standard uncertainty beside it (`sigma_*`, k = 1), and
``Result.uncertainty_includes`` says what is in it: the calibration's part is missing where its covariance is not known.

:class:`stereorig.Client` and :class:`stereorig.AsyncClient` drive a running service instead: rig, tests, results.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from core.errors import StereorigError
    from core.gauge.area import AreaStatistics
    from core.gauge.extensometer import Extensometer
    from core.gauge.reading import Reading
    from core.gauge.rigid import RigidMotion
    from core.settings import AnalysisSettings, Region, StrainSettings
    from core.status import PointStatus
    from server.formats.calibrations.recognise import LoadedCalibration as Calibration
    from server.formats.images import read_image
    from server.formats.noise_json import LoadedNoise as Noise
    from server.formats.noise_json import load_noise as read_noise
    from stereorig.calibration import calibrate, read_calibration
    from stereorig.client import AsyncClient, Client
    from stereorig.measurement import Measurement
    from stereorig.result import Result, read_result

    __version__: str

#: where each name lies; it is imported when it is first used
_LIES_IN = {
    "AnalysisSettings": "core.settings",
    "AreaStatistics": "core.gauge.area",
    "AsyncClient": "stereorig.client",
    "Calibration": "server.formats.calibrations.recognise:LoadedCalibration",
    "Client": "stereorig.client",
    "Extensometer": "core.gauge.extensometer",
    "Measurement": "stereorig.measurement",
    "Noise": "server.formats.noise_json:LoadedNoise",
    "PointStatus": "core.status",
    "Reading": "core.gauge.reading",
    "Region": "core.settings",
    "Result": "stereorig.result",
    "RigidMotion": "core.gauge.rigid",
    "StereorigError": "core.errors",
    "StrainSettings": "core.settings",
    "calibrate": "stereorig.calibration",
    "read_calibration": "stereorig.calibration",
    "read_image": "server.formats.images",
    "read_noise": "server.formats.noise_json:load_noise",
    "read_result": "stereorig.result",
}

__all__ = [
    "AnalysisSettings",
    "AreaStatistics",
    "AsyncClient",
    "Calibration",
    "Client",
    "Extensometer",
    "Measurement",
    "Noise",
    "PointStatus",
    "Reading",
    "Region",
    "Result",
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
        from server.formats.version import software_version

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
