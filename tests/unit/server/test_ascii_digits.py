"""Digits are 0 to 9: those of other scripts, which int() reads too, name no step, test, port or number."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.store.bundle.content import Contents
from stereorig.server.store.folder import DataFolder, is_id
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import verify
from tests.support.copied_tests import write_test_folder
from tests.support.requirements import ROOT
from tests.support.tiny_rig import TINY

ARABIC = str.maketrans("0123456789", "٠١٢٣٤٥٦٧٨٩")
#: a class of digits, or a method that takes those of every script
_CLASS = re.compile(r"(?<!\\)(?:\\\\)*\\d")
#: it looks at the whole cell before
_CHECKED = "server/formats/channel_table.py"
_METHODS = {"isdigit", "isdecimal", "isnumeric"}


def found_in(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    found = []
    for node in ast.walk(ast.parse("\n".join(lines))):
        text = isinstance(node, ast.Constant) and isinstance(node.value, str) and _CLASS.search(node.value)
        method = isinstance(node, ast.Attribute) and node.attr in _METHODS and "isascii" not in lines[node.lineno - 1]
        if text or method:
            found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    return found


def test_no_pattern_of_the_program_takes_the_digits_of_other_scripts() -> None:
    paths = [
        path for package in ("core", "drivers", "server", "sim", "stereorig") for path in (ROOT / package).rglob("*.py")
    ]
    assert len(paths) > 300
    found = [place for path in paths for place in found_in(path)]
    assert [place for place in found if not place.startswith(_CHECKED)] == []


@pytest.mark.parametrize("text", ["t000001-abcdef".translate(ARABIC), "t00000١-abcdef", "t00000²-abcdef"])
def test_an_id_has_ascii_digits(text: str) -> None:
    assert is_id("t000001-abcdef", "t")
    assert not is_id(text, "t")
    with pytest.raises(ValueError, match="test_id"):
        Contents.model_validate({"format": 1, "test_id": text, "files": {}})


def test_a_step_folder_of_other_digits_is_foreign_and_takes_no_step_with_it(tmp_path: Path) -> None:
    data = DataFolder(tmp_path / "data")
    data.open().close()
    test = data.tests / "t000001-abcdef"
    write_test_folder(test, 3)
    (test / "steps" / "0002").rename(test / "steps" / "0002".translate(ARABIC))
    steps = TestStore(data).steps
    assert list(steps.newest("t000001-abcdef")) == [1, 0]
    levels = [finding.level for finding in verify(data.root).findings]
    assert "foreign" in levels
    assert "damaged" in levels, "the manifest names the files of step 2"


def test_a_port_has_ascii_digits() -> None:
    with pytest.raises(Exception, match="scheduler"):
        parse_config(f'{TINY}\n[compute]\nscheduler = "tcp://host:{"8786".translate(ARABIC)}"')
