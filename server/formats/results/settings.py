"""Settings and input hashes of result files in today's form; the one place that knows the older ones.

Format 1 had two dialects. The service wrote ``calibration.json``, ``step_cam1``, ``step_cam2`` and ``noise.json`` among
the input hashes; ``stereorig measure`` wrote its region as ``roi``, ``cracks``, ``holes`` and ``mask`` beside the other
settings, and ``step`` for a step's number in ``summary.json``. What a later version added has the value that the
earlier one worked with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from core.settings import StoredSettings

_INPUTS = {"calibration.json": "calibration", "noise.json": "noise", "step_cam1": "cam1", "step_cam2": "cam2"}
_CUTS_AND_MASK = ("cracks", "holes", "mask")
#: of settings that came later, what measurements did before
_BEFORE = {"reference_update": "never", "strain": None}


def current_settings(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result's settings in today's form."""
    if "roi" not in document:
        return dict(document)
    region = {"rectangle": document["roi"], **{name: document[name] for name in _CUTS_AND_MASK if name in document}}
    settings = {name: value for name, value in document.items() if name not in ("roi", *_CUTS_AND_MASK)}
    return {**settings, "region": region}


def stored_settings(document: Mapping[str, Any]) -> StoredSettings:
    """Return the settings of an analysis, whichever version began it."""
    return StoredSettings.model_validate({**_BEFORE, **current_settings(document)})


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
