"""Settings and input hashes of result files in their current form; older forms are read by this module alone.

Format 1 had two dialects. The service wrote ``calibration.json``, ``step_cam1``, ``step_cam2`` and ``noise.json`` among
the input hashes; ``stereorig measure`` wrote its region as ``roi``, ``cracks``, ``holes`` and ``mask`` beside the other
settings, and ``step`` for a step's number in ``summary.json``. What a later version added has the value that the
earlier one worked with. Format 1, and files of format 2 from before the glossary, have ``step_px`` for ``spacing_px``,
``stretch`` and ``curved`` for the patches ``affine`` and ``quadratic``, ``handed_on`` for ``propagated``, and other
names of the comparisons.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

from core.settings import StoredSettings, patch_name

_INPUTS = {"calibration.json": "calibration", "noise.json": "noise", "step_cam1": "cam1", "step_cam2": "cam2"}
_CUTS_AND_MASK = ("cracks", "holes", "mask")
#: settings that came later: the values that correspond to earlier measurements
_BEFORE = {"reference_update": "never", "split_step": "never", "strain": None}


_ENTRIES = {
    "step_px": "spacing_px",
    "curved_noise_mm": "quadratic_noise_mm",
    "curved_advised": "quadratic_advised",
    "least_share": "min_share",
    "most_amplification": "max_amplification",
}
_COMPARISONS = {
    "cam1_t0__cam2_t0": "cam1_ref__cam2_ref",
    "cam1_t0__cam1_t": "cam1_ref__cam1_cur",
    "cam1_t0__cam2_t": "cam1_ref__cam2_cur",
}
_RECORDS = ("patch", "smoothing", "strain")
_PROPAGATED, _PROPAGATED_BEFORE = "propagated_", "handed_on_"


def current_entries(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a flat record (of settings, a patch choice, a smoothing, strain) with today's names."""
    out = {_ENTRIES.get(name, name): value for name, value in document.items()}
    return out | {name: patch_name(out[name]) for name in ("patch", "asked") if isinstance(out.get(name), str)}


def variable_name(name: str, there: Container[str]) -> str:
    """Return the name under which a result file holds a variable."""
    earlier = name.replace(_PROPAGATED, _PROPAGATED_BEFORE, 1) if name.startswith(_PROPAGATED) else name
    return earlier if name not in there and earlier in there else name


def current_settings(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result's settings in today's form."""
    document = current_entries(document)
    if "roi" not in document:
        return document
    region = {"rectangle": document["roi"], **{name: document[name] for name in _CUTS_AND_MASK if name in document}}
    settings = {name: value for name, value in document.items() if name not in ("roi", *_CUTS_AND_MASK)}
    return {**settings, "region": region}


def stored_settings(document: Mapping[str, Any]) -> StoredSettings:
    """Return the settings of an analysis, whichever version began it."""
    return StoredSettings.model_validate({**_BEFORE, **current_settings(document)})


def current_inputs(inputs: Mapping[str, str]) -> dict[str, str]:
    """Return the hashes of a result's inputs by today's names."""
    return {_INPUTS.get(name, name): sha256 for name, sha256 in inputs.items()}


def current_step(step: Mapping[str, Any]) -> dict[str, Any]:
    """Return a step's entry of ``summary.json`` in today's form."""
    out = {**step, "n": step.get("n", step.get("step")), "wall_s": step.get("wall_s", step.get("seconds"))}
    out |= {name: current_entries(step[name]) for name in _RECORDS if isinstance(step.get(name), dict)}
    if isinstance(step.get("zncc_median"), dict):
        out["zncc_median"] = {_COMPARISONS.get(name, name): value for name, value in step["zncc_median"].items()}
    return out


def current_summary(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``summary.json`` in today's form."""
    out = {**document, "steps": [current_step(s) for s in document.get("steps", []) if isinstance(s, dict)]}
    if isinstance(document.get("settings"), dict):
        out["settings"] = current_settings(document["settings"])
    return out
