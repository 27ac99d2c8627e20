"""Provenance of a step's numbers, as every export states it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.version import software_version
from stereorig.server.results.steps import ExportSource, StepResult, statement_of


def provenance(step: StepResult, source: ExportSource, *, path: Path | None = None) -> dict[str, object]:
    """Return the provenance that every export states: software, frame, settings, calibration, inputs; values are plain.

    Parameters
    ----------
    path
        The result file, whose checksum is stated.
    """
    recorded = step.attributes
    document: dict[str, object] = {
        "software": f"stereorig {software_version()}",
        "measured_with": recorded.get("source", ""),
        "measured": recorded.get("created", ""),
        "kind": recorded.get("kind", ""),
        "frame": recorded.get("frame", ""),
        "length_unit": "mm",
        "settings": _json(step, "settings"),
        "calibration_sha256": calibration_of(step),
        "inputs_sha256": _json(step, "inputs_sha256"),
        "uncertainty": statement_of(step, source).document(),
        **({"stale_reasons": list(source.stale_reasons)} if source.stale_reasons else {}),
        **source.about,
    }
    for name in ("strain", "smoothing", "patch_choice", "transformation", "dense"):
        if name in recorded:
            document[name] = _json(step, name)
    for name in ("strain_axes", "strain_note", "patch", "patch_reason", "made_from", "method", "neighbours"):
        if name in recorded:
            document[name] = recorded[name]
    document["step"] = step.n
    document["label"], document["load_n"] = step.label, step.load_n
    if step.recorded.time_s is not None:
        document["time_s"] = step.recorded.time_s
    if step.recorded.channels:
        document["channels"] = dict(step.recorded.channels)
        document["channel_units"] = dict(step.recorded.units)
    if step.recorded.u:
        document["channel_u"] = dict(step.recorded.u)
    if path is not None:
        document["result_file"] = path.name
        document["result_sha256"] = sha256_of(path)
    return document


def calibration_of(step: StepResult) -> str | None:
    """Return the SHA-256 of the calibration that a step was measured with; None where the file does not state it."""
    inputs = _json(step, "inputs_sha256")
    return inputs.get("calibration")


def notes_of(step: StepResult, source: ExportSource) -> list[str]:
    """Return the lines that state a picture's provenance."""
    settings, strain = _json(step, "settings"), _json(step, "strain")
    parts = [
        f"{name} {settings[key]}{unit}"
        for name, key, unit in (
            ("subset", "subset_px", " px"),
            ("step", "spacing_px", " px"),
            ("patch", "patch", ""),
            ("interpolation", "interpolation", ""),
            ("prefilter", "prefilter_px", " px"),
            ("smoothing window", "smoothing_window", " points"),
        )
        if settings.get(key)
    ]
    if strain:
        mm = strain.get("gauge_mm")
        parts.append(f"gauge {strain['gauge_px']:g} px{'' if mm is None else f' = {mm:.3g} mm'}, {strain['tensor']}")
    calibration = source.about.get("calibration_id"), (calibration_of(step) or "")[:12]
    known = " ".join(str(part) for part in calibration if part) or "not known"
    frame, measured_with = (step.attributes.get(name, "") for name in ("frame", "source"))
    return [
        f"frame: {frame}",
        f"{', '.join(parts)}; calibration {known}; {measured_with}",
        statement_of(step, source).text,
    ]


def _json(step: StepResult, name: str) -> dict[str, Any]:
    """An attribute that holds JSON; empty if it is missing."""
    read: dict[str, Any] = json.loads(str(step.attributes.get(name, "{}")))
    return read
