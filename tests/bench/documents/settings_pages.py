"""The pages of an analysis' settings and of the target file, from the models that read them."""

from __future__ import annotations

from typing import Any

from core.settings import AnalysisSettings
from server.config.reference import default_text, json_schema, kind_of_value
from tests.bench.documents.prose import cell

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
    "split_step": "`--split-step`",
    "pattern": "`--projected`",
    "strain": "`--strain`, `--strain-order`, `--strain-tensor`",
    "smoothing_window": "`--smooth`",
    "dense_step_px": "`--dense`",
}
_HEAD = """# Analysis settings

The parameters of a measurement: fields of `POST /tests/{test_id}/analyses`, options of `stereorig measure`, and the attribute
`settings` of every result file. They are declared once, in `core/settings.py`, from which this page is written
(`make reference`). How to choose them: [lens, subset, spacing](../how_to/lens_subset_spacing.md).

"""
_TARGET = """# Target file

`stereorig calibrate --target TARGET.toml` reads the calibration grid from these keys, at top level or in a table `[target]`; a
[rig file](rig_file.md) has the same table. The grid is two families of equidistant lines that cross at right angles, seen at
45 degrees to the image's rows. Only inner intersections are used: 9 x 9 of 11 x 11 lines. Written by `make reference`.

"""
_EXAMPLE = """
## Example

```toml
pitch_mm = 1.0
lines = [11, 11]            # lines crossed walking along X_sys and along Y_sys
line_width_mm = 0.03
node_tolerance_mm = 0.004   # the maker's bound; 0 for a grid taken as exact
dark_lines = true
```
"""


def _table(model: dict[str, Any], known: dict[str, Any], options: dict[str, str] | None) -> list[str]:
    more = " option |" if options is not None else ""
    lines = [
        f"| key | value | default |{more} meaning |",
        "| --- | --- | --- |" + (" --- |" if more else "") + " --- |",
    ]
    required = set(model.get("required", ()))
    for key, field in model["properties"].items():
        default = "**required**" if key in required else default_text(field.get("default"))
        option = f" {options.get(key, '')} |" if options is not None else ""
        value = cell(kind_of_value(field, known))
        lines.append(f"| `{key}` | {value} | {default} |{option} {cell(field.get('description', ''))} |")
    return lines


def pages() -> dict[str, str]:
    """Return the pages by their paths below docs/reference."""
    schema = AnalysisSettings.model_json_schema()
    known = schema["$defs"]
    lines = _table(schema, known, OPTIONS)
    for name, title in (("Region", "region"), ("StrainSettings", "strain")):
        text = known[name].get("description", "").replace("\n", " ")
        lines += ["", f"## `{title}`", "", text, "", *_table(known[name], known, None)]
    rig = json_schema()["$defs"]
    target = _TARGET + "\n".join(_table(rig["TargetSection"], rig, None)) + "\n" + _EXAMPLE
    return {"settings.md": _HEAD + "\n".join(lines) + "\n", "target_file.md": target}
