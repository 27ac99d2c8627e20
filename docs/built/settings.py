"""The lists of keys: settings of an analysis, the target file, the rig file; from the models that read them."""

from __future__ import annotations

from typing import Any

from docs.built.tables import cell, table
from stereorig.core.settings import AnalysisSettings
from stereorig.server.config.reference import default_text, json_schema, kind_of_value, markdown

#: options of `stereorig measure` for each setting
OPTIONS = {
    "region": "`--roi`, `--mask`, `--crack`, `--hole`",
    "subset_px": "`--subset`",
    "spacing_px": "`--step`",
    "patch": "`--patch`",
    "interpolation": "`--interpolation`",
    "prefilter_px": "`--prefilter`",
    "keep_rejected": "`--keep-rejected`",
    "max_sigma_px": "`--max-sigma`",
    "seeds": "`--seed`",
    "seeds_cam2": "`--seed X,Y,X2,Y2`",
    "reference_update": "`--reference-update`",
    "pattern": "`--projected`",
    "strain": "`--strain`, `--strain-order`, `--strain-tensor`",
    "smoothing_window": "`--smooth`",
    "dense_step_px": "`--dense`",
}


def analysis() -> str:
    """Return the settings of an analysis, then those of its region and its strain."""
    schema = AnalysisSettings.model_json_schema()
    known = schema["$defs"]
    parts = [_keys(schema, known, options=OPTIONS)]
    for name, title in (("Region", "region"), ("StrainSettings", "strain")):
        text = known[name].get("description", "").replace("\n", " ")
        parts += [f"## `{title}`", text, _keys(known[name], known)]
    return "\n\n".join(parts)


def target() -> str:
    """Return the keys of a target file."""
    known = json_schema()["$defs"]
    return _keys(known["TargetSection"], known)


def rig_file() -> str:
    """Return what `stereorig rigfile` prints, but for its title."""
    return markdown().partition("\n\n")[2]


def _keys(model: dict[str, Any], known: dict[str, Any], *, options: dict[str, str] | None = None) -> str:
    required = set(model.get("required", ()))
    rows = []
    for key, field in model["properties"].items():
        default = "**required**" if key in required else default_text(field.get("default"))
        option = [options.get(key, "")] if options else []
        value, meaning = cell(kind_of_value(field, known)), cell(field.get("description", ""))
        rows.append((f"`{key}`", value, default, *option, meaning))
    return table(("key", "value", "default", *(["option"] if options else []), "meaning"), rows)
