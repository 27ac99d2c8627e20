"""Settings and input hashes of result files in today's form; the one place that knows the older ones.

Format 1 had two dialects. The service wrote ``calibration.json``, ``step_cam1``, ``step_cam2`` and ``noise.json`` among
the input hashes; ``stereorig measure`` wrote its region as ``roi``, ``cracks``, ``holes`` and ``mask`` beside the other
settings, and ``step`` for a step's number in ``summary.json``. What a later version added has the value that the
earlier one worked with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_INPUTS = {"calibration.json": "calibration", "noise.json": "noise", "step_cam1": "cam1", "step_cam2": "cam2"}
_REGION = ("rectangle", "polygon", "cracks", "holes", "mask")
#: of settings that came later, what measurements did before
_BEFORE = {"reference_update": "never", "prefilter_px": 0.0, "smoothing_window": None, "start_from": "previous"}


def current_settings(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return stored settings in today's form; see :class:`core.settings.StoredSettings`."""
    settings = {name: value for name, value in document.items() if name not in ("roi", *_REGION)}
    region = dict(document.get("region") or {})
    if "roi" in document:
        region = {"rectangle": document["roi"], **{name: document.get(name) for name in _REGION[2:]}}
    if region:
        cuts = {name: region.get(name) or [] for name in ("cracks", "holes")}
        settings["region"] = {**dict.fromkeys(_REGION), **region, **cuts}
    return {**_BEFORE, **settings}


def current_inputs(inputs: Mapping[str, str]) -> dict[str, str]:
    """Return the hashes of a result's inputs by today's names."""
    return {_INPUTS.get(name, name): sha256 for name, sha256 in inputs.items()}


def current_summary(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``summary.json`` in today's form."""
    steps = [
        {**step, "n": step.get("n", step.get("step")), "wall_s": step.get("wall_s", step.get("seconds"))}
        for step in document.get("steps", [])
        if isinstance(step, dict)
    ]
    return {**document, "steps": steps}
