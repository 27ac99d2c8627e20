"""The command line's help: commands by what they are for, each once; older names still work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stereorig.server.cli.main import COMMANDS, GROUPS, main

#: simulators, and older names of what is listed
HIDDEN = {"simstage", "simframe", "guide", "repair"}


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_each_command_is_listed_once_under_what_it_is_for(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, "--help")
    assert re.findall(r"^(\w+):$", text, re.MULTILINE)[-5:] == ["rig", "calibrate", "measure", "look", "keep"]
    listed = re.findall(r"^  ([a-z-]+) {2,}\S", text, re.MULTILINE)
    listed = [name for name in listed if name in COMMANDS]
    assert sorted(listed) == sorted(set(COMMANDS) - HIDDEN)
    assert [name for names in GROUPS.values() for name in names] == listed
    assert all(len(line) <= 110 for line in text.splitlines())


def test_a_target_held_by_hand_is_a_way_to_calibrate(capsys: pytest.CaptureFixture[str]) -> None:
    by_hand, old = printed(capsys, "calibrate", "--by-hand", "--help"), printed(capsys, "guide", "--help")
    assert by_hand == old
    assert "--goal-um" in by_hand
    assert "--by-hand" in printed(capsys, "calibrate", "--help")


def test_a_folder_is_put_in_order_by_verify_or_by_the_old_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    codes = []
    for arguments in (["verify", "--repair"], ["repair"]):
        codes.append((main([*arguments, str(tmp_path / "none")]), capsys.readouterr().err))
    assert codes[0] == codes[1]
    assert codes[0][0] == 1
