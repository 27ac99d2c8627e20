"""Our structures against the kernel's own header, by a C program that prints what the compiler makes of it."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from stereorig.drivers.cameras.v4l2 import structures as v
from tests.support.requirements import missing

# members of unnamed unions go by our name for the union
_UNNAMED = {"FrmSizeEnum": {"u": "discrete"}, "FrmIvalEnum": {"u": "discrete"}, "QueryMenu": {"u": "name"}}
_UNNAMED["ExtControl"] = {"u": "value"}


def _structures() -> dict[str, type[ctypes.Structure]]:
    return {
        name: thing
        for name, thing in vars(v).items()
        if isinstance(thing, type) and issubclass(thing, ctypes.Structure) and not name.startswith("_")
    }


def _constants() -> dict[str, int]:
    return {n: x for n, x in vars(v).items() if isinstance(x, int) and n.isupper() and not n.startswith("_")}


def _c_name(constant: str) -> str:
    return constant if constant.startswith(("VIDIOC_", "VIDEO_MAX")) else f"V4L2_{constant}"


@pytest.fixture(scope="module")
def header(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    if shutil.which("gcc") is None:
        missing("gcc (Debian: gcc, libc6-dev)")
    if not Path("/usr/include/linux/videodev2.h").is_file():
        missing("linux/videodev2.h (Debian: linux-libc-dev)")
    lines = ["#include <stdio.h>", "#include <stddef.h>", "#include <linux/videodev2.h>", "int main(void) {"]
    for name, structure in _structures().items():
        c = re.search(r"``(struct \w+)``", structure.__doc__ or "").group(1)
        lines.append(f'printf("{name} %zu\\n", sizeof({c}));')
        for field in (f[0] for f in structure._fields_):
            member = _UNNAMED.get(name, {}).get(field, field)
            lines.append(f'printf("{name}.{field} %zu\\n", offsetof({c}, {member}));')
    lines += [f'printf("{name} %llu\\n", (unsigned long long)(unsigned int){_c_name(name)});' for name in _constants()]
    folder = tmp_path_factory.mktemp("header")
    (folder / "print.c").write_text("\n".join([*lines, "return 0; }"]))
    subprocess.run(["gcc", "-Wall", "-Werror", "-o", folder / "print", folder / "print.c"], check=True)
    printed = subprocess.run([folder / "print"], check=True, capture_output=True, text=True).stdout
    return {name: int(number) for name, number in (line.split() for line in printed.splitlines())}


def test_sizes_and_offsets_are_the_headers(header: dict[str, int]) -> None:
    for name, structure in _structures().items():
        assert ctypes.sizeof(structure) == header[name], name
        for field in (f[0] for f in structure._fields_):
            assert getattr(structure, field).offset == header[f"{name}.{field}"], f"{name}.{field}"


def test_numbers_are_the_headers(header: dict[str, int]) -> None:
    for name, number in _constants().items():
        assert number == header[name], name
