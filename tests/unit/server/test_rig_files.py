"""The rig files in config/ can be used, and the reference of their keys is that of the model."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.cli import main
from stereorig.server.config.reference import json_schema, markdown
from stereorig.server.config.rig_file import RigConfig, load_config, parse_config
from stereorig.server.rig.build import check_config, first_settings
from tests.support.requirements import ROOT

FILES = sorted((ROOT / "config").glob("*.toml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_rig_file_is_good(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_config(load_config(path))
    assert main(["rigfile", str(path)]) == 0
    assert "good" in capsys.readouterr().out


def test_every_key_of_the_model_stands_on_the_page_with_a_meaning() -> None:
    page = markdown()
    schema = json_schema()
    for name, section in schema["$defs"].items():
        for key, field in section.get("properties", {}).items():
            assert field.get("description"), (name, key)
            assert f"| `{key}` |" in page, (name, key)
    for line in page.splitlines():
        if line.startswith("| `"):
            assert "None" not in line.split("|")[2], line
            assert "{" not in line.split("|")[2], line


def _accepts(schema: dict[str, Any], value: Any, known: dict[str, Any]) -> bool:
    """Check a value against a JSON schema, written anew from the standard for the words that are used here."""
    if "$ref" in schema:
        return _accepts(known[schema["$ref"].rsplit("/", 1)[-1]], value, known)
    if "anyOf" in schema:
        return any(_accepts(option, value, known) for option in schema["anyOf"])
    if "const" in schema:
        return bool(value == schema["const"])
    if "enum" in schema:
        return value in schema["enum"]
    kind = schema.get("type")
    if kind == "object":
        if not isinstance(value, dict) or not set(schema.get("required", ())) <= set(value):
            return False
        properties, more = schema.get("properties", {}), schema.get("additionalProperties", True)
        for key, item in value.items():
            rule = properties.get(key, more)
            if rule is False or (isinstance(rule, dict) and not _accepts(rule, item, known)):
                return False
        return True
    if kind == "array":
        rules = schema.get("prefixItems") or [schema["items"]] * len(value)
        return len(rules) == len(value) and all(_accepts(r, v, known) for r, v in zip(rules, value, strict=True))
    if kind in ("number", "integer"):
        right = isinstance(value, int | float) and not isinstance(value, bool)
        return (
            right
            and schema.get("minimum", value) <= value <= schema.get("maximum", value)
            and not ("exclusiveMinimum" in schema and value <= schema["exclusiveMinimum"])
        )
    return isinstance(value, {"string": str, "boolean": bool}.get(str(kind), object))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_schema_takes_good_files_and_no_unknown_key(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rigfile", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    data = tomllib.loads(path.read_text())
    assert _accepts(schema, data, schema["$defs"])
    data["cam1"]["expsure_ms"] = 3.0
    assert not _accepts(schema, data, schema["$defs"])
    del data["cam1"]["expsure_ms"]
    data["cam1"]["phd_px"] = 0.0
    assert not _accepts(schema, data, schema["$defs"])


def test_bad_files_are_named_with_the_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(FILES[0].read_text().replace("soft_limits_mm", "soft_limit_mm"))
    assert main(["rigfile", str(FILES[0]), str(bad)]) == 1
    out = capsys.readouterr().out
    assert "soft_limit" in out
    assert f"{FILES[0]}: " in out


def test_without_a_file_the_page_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rigfile"]) == 0
    out = capsys.readouterr().out
    assert all(f"`[{name}]`" in out or f"`[[{name}]]`" in out for name in RigConfig.model_fields)


def test_the_laboratory_file_explains_every_key() -> None:
    text = (ROOT / "config" / "lab_aravis_esp301.toml").read_text()
    for section in json_schema()["$defs"].values():
        for key in section.get("properties", {}):
            assert (
                re.search(rf"^(# +)?{key} = ", text, re.MULTILINE)
                or f"[stage.{key}." in text
                or f"[cam1.{key}]" in text
            ), key


def test_keys_behind_a_comment_sign_may_be_taken_in() -> None:
    path = ROOT / "config" / "lab_aravis_esp301.toml"
    text = re.sub(r"^# (\w+ = )", r"\1", path.read_text(), flags=re.MULTILINE)
    assert text != path.read_text()
    parse_config(text)


BOARD = (ROOT / "config" / "sim_board.toml").read_text()
GRID = (ROOT / "config" / "sim_paper.toml").read_text()


def test_a_target_keeps_the_fields_of_its_kind() -> None:
    grid = parse_config(GRID).target
    # what is kept with calibrations of a line grid is what has always been
    assert grid.plain() == {
        "pitch_mm": 1.0,
        "lines": [11, 11],
        "line_width_mm": 0.03,
        "node_tolerance_mm": 0.004,
        "pitch_scale_sigma": 0.0,
        "dark_lines": True,
    }
    assert parse_config(BOARD).target.plain() == {
        "kind": "charuco",
        "pitch_mm": 8.0,
        "size": [9, 6],
        "marker_mm": 6.0,
        "dictionary": "DICT_5X5_100",
        "node_tolerance_mm": 0.01,
    }
    dots = BOARD.replace('kind = "charuco"', 'kind = "circles_asymmetric"')
    dots = re.sub(r"^(marker_mm|dictionary) = .*$", "", dots, flags=re.MULTILINE)
    assert parse_config(dots).target.kind == "circles_asymmetric"


@pytest.mark.parametrize(
    ("text", "old", "new", "cause"),
    [
        (GRID, "lines = [11, 11]", "", "needs lines"),
        (GRID, "line_width_mm = 0.03", "", "needs line_width_mm"),
        (GRID, "lines = [11, 11]", "lines = [11, 11]\nsize = [9, 6]", "has no size"),
        (BOARD, "size = [9, 6] ", "# ", "needs size"),
        (BOARD, "marker_mm = 6.0", "", "needs marker_mm"),
        (BOARD, "marker_mm = 6.0", "marker_mm = 8.0", "smaller than pitch_mm"),
        (BOARD, "marker_mm = 6.0", "marker_mm = 6.0\ndark_lines = true", "has no dark_lines"),
        (BOARD, 'kind = "charuco"', 'kind = "circles"', "has no marker_mm, dictionary"),
        (BOARD, 'kind = "charuco"', 'kind = "tomato"', "target.kind"),
        (BOARD, "size = [9, 6]", "size = [2, 6]", "target.size"),
        (BOARD, "DICT_5X5_100", "5X5", "target.dictionary"),
    ],
)
def test_a_target_with_the_fields_of_another_kind_is_refused(text: str, old: str, new: str, cause: str) -> None:
    assert old in text
    with pytest.raises(FileFormatError) as caught:
        parse_config(text.replace(old, new))
    assert caught.value.code == "config_invalid"
    assert cause in caught.value.cause


def test_one_stage_means_one_axis_and_free_poses_need_no_placing() -> None:
    one_axis = BOARD.replace("stage_axis = 1              # one axis", "stage_axis = 2              # one axis")
    with pytest.raises(FileFormatError, match="one stage axis"):
        parse_config(one_axis)
    placed = re.sub(r"(?m)^(standoff_mm|angle_deg) = .*\n", "", BOARD)
    with pytest.raises(FileFormatError, match=r"cam1\.standoff_mm is needed"):
        parse_config(placed)
    free = parse_config(
        placed.replace('moves = "target"', 'moves = "free"').replace("positions_mm = [0.0, 10.0]\n", "")
    )
    assert free.cam1.standoff_mm is None
    assert free.calibration.positions_mm == ()
    with pytest.raises(FileFormatError, match="positions_mm is needed"):
        parse_config(BOARD.replace("positions_mm = [0.0, 10.0]\n", ""))


LAB = (ROOT / "config" / "lab_aravis_esp301.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("trigger", ["free", "software", "hardware"])
def test_a_driven_camera_waits_for_its_line_with_any_trigger_of_the_driving_camera(trigger: str) -> None:
    text = LAB.replace('trigger = "hardware"', f'trigger = "{trigger}"').replace("# strobe_line", "strobe_line")
    config = parse_config(text)
    assert (config.driving, config.trigger_of("cam1"), config.trigger_of("cam2")) == ("cam1", trigger, "hardware")
    features = first_settings(config, "cam1").features
    assert features is not None
    assert dict(list(features.items())[:3]) == {
        "LineSelector": "Line2",
        "LineMode": "Output",
        "LineSource": "ExposureActive",
    }


@pytest.mark.parametrize(
    ("before", "after", "word"),
    [
        ("[cam2]\n", '[cam2]\nstrobe_line = "Line3"\n', "only one camera"),
        ('trigger = "hardware"', 'trigger = "action"', "no strobe_line"),
        ('driver = "aravis"', 'driver = "v4l2"', "GenICam"),
    ],
)
def test_roles_that_no_rig_can_have_are_refused(before: str, after: str, word: str) -> None:
    text = LAB.replace("# strobe_line", "strobe_line")
    with pytest.raises(FileFormatError, match=word):
        parse_config(text.replace(before, after))


def test_an_action_at_a_time_needs_clocks_that_follow_a_master() -> None:
    text = LAB.replace('trigger = "hardware"', 'trigger = "action"').replace("# action_lead_ms", "action_lead_ms")
    with pytest.raises(FileFormatError, match="ptp = true"):
        parse_config(text)
