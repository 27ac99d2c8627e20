"""No pattern of the program takes longer than its text: what a client sends may be one run of blanks."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import hypothesis
import pytest
from hypothesis import strategies as st

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.channel_table import read_channel_table
from stereorig.server.formats.models.table import read_table

ROOT = Path(__file__).parents[3]
PACKAGES = ("core", "drivers", "server", "sim", "stereorig")
METHODS = {"match", "search", "fullmatch", "sub", "subn", "findall", "split", "finditer"}
#: patterns that are no constant of the program: of the rig file, of its owner, and checked when it is read
OTHERS = {("drivers/channels/lines.py", "self.pattern"), ("server/config/rig_file.py", "self.pattern")}

# Each text is tried at growing length, by processor time, so that other work of the machine does not count: of 3,000
# characters a pattern of n^2 takes a tenth of a second, a linear one some hundredths of a millisecond.
CHILD = """
import json, re, sys, time
FILLS = [" ", "\\t", "\\n", "0", "\\u0660", '"', "'", "[", "]", "(", ")", "{", "}", ".", "a", "A", "_", "-", ",", ";",
         ":", "=", "/", "#", "<", ">", "a ", "[a", "1.", "a,", "0 "]
WHOLE = [("a[", " ", "b)c"), ("", " ", "x"), ("a", " ", ","), ("", "\\n", ""), ("a#", " ", "x\\ny")]

def timed(pattern, method, text):
    use = getattr(pattern, method)
    begin = time.thread_time()
    if method in ("sub", "subn"):
        use(text[:0], text)
    elif method == "finditer":
        list(use(text))
    else:
        use(text)
    return time.thread_time() - begin

for line in sys.stdin:
    where, source, flags, is_bytes, method, sample = json.loads(line)
    pattern = re.compile(source.encode("latin-1") if is_bytes else source, flags)
    texts = WHOLE + [(sample[:k], fill, "\\x01") for k in range(len(sample) + 1) for fill in FILLS]
    worst = []
    print("@", where, repr(source), method, flush=True)
    for head, fill, tail in texts:
        taken = 0.0
        for n in (300, 1_000, 3_000):
            text = head + fill * n + tail
            taken = timed(pattern, method, text.encode("latin-1", "replace") if is_bytes else text)
            if taken > 0.04:
                print("SLOW", where, repr(source), method, repr((head, fill, n, tail)), taken, flush=True)
                break
        if taken > 0.04:
            worst = []
            break
        worst.append((taken, head, fill, tail))
    for _, head, fill, tail in sorted(worst)[-4:]:
        text = head + fill * 100_000 + tail
        if (taken := timed(pattern, method, text.encode("latin-1", "replace") if is_bytes else text)) > 1.5:
            print("SLOW", where, repr(source), method, repr((head, fill, tail)), taken, flush=True)
"""


def _value(module: str, node: ast.expr) -> object:
    """Value of an expression in its module."""
    try:
        return ast.literal_eval(node)
    except ValueError:
        names = vars(importlib.import_module(module))
        return eval(compile(ast.Expression(node), module, "eval"), dict(names))


def patterns() -> list[tuple[str, str, int, bool, str]]:
    """Return place, source, flags, kind and method of each pattern of the program."""
    found, texts = [], {path: path.read_text() for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))}
    uses = set(re.findall(r"\b(\w+)\.(" + "|".join(METHODS) + r")\(", "\n".join(texts.values())))
    for path, text in texts.items():
        where, tree = path.relative_to(ROOT).as_posix(), ast.parse(text)
        dotted = where.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
        module = dotted if dotted.startswith("stereorig") else f"stereorig.{dotted}"
        named = {
            id(node.value): target.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            wanted: list[tuple[ast.expr, set[str]]] = []
            if isinstance(node, ast.Call):
                wanted += [(k.value, {"search"}) for k in node.keywords if k.arg in ("pattern", "regex")]
                call = node.func
                if isinstance(call, ast.Attribute) and isinstance(call.value, ast.Name) and call.value.id == "re":
                    if call.attr == "compile":
                        own = {method for name, method in uses if name == named.get(id(node))}
                        wanted.append((node.args[0], own or {"fullmatch"}))
                    elif call.attr in METHODS:
                        wanted.append((node.args[0], {call.attr}))
            elif isinstance(node, ast.ClassDef):  # a convertor of the routes
                wanted += [
                    (one.value, {"fullmatch"})
                    for one in node.body
                    if isinstance(one, ast.Assign) and getattr(one.targets[0], "id", "") == "regex"
                ]
            for expression, methods in wanted:
                source = ast.unparse(expression)
                if (where, source) in OTHERS:
                    continue
                try:
                    value = _value(module, expression)
                except (NameError, AttributeError):
                    continue  # of a function: its own source is looked at where it is made
                if isinstance(value, re.Pattern):
                    value = value.pattern
                if not isinstance(value, str | bytes):
                    continue
                flags = 0
                if isinstance(node, ast.Call):
                    last = node.args[-1] if len(node.args) > 1 else None
                    given = [k.value for k in node.keywords if k.arg == "flags"] or ([last] if last is not None else [])
                    flags = next((int(f) for g in given if isinstance(f := _flags(g), int)), 0)
                is_bytes = isinstance(value, bytes)
                plain = value.decode("latin-1") if isinstance(value, bytes) else value
                found += [(where, plain, flags, is_bytes, method) for method in sorted(methods)]
    return sorted(set(found))


def _flags(node: ast.expr) -> int | None:
    text = ast.unparse(node)
    return int(eval(text, {"re": re})) if text.startswith("re.") else None


def _sample(source: str, flags: int, is_bytes: bool) -> str:
    """Return a short text that a pattern takes."""
    made = re.compile(source.encode("latin-1") if is_bytes else source, flags)
    found: list[str | bytes] = []

    @hypothesis.settings(
        database=None, max_examples=1, deadline=None, derandomize=True, phases=[hypothesis.Phase.generate]
    )
    @hypothesis.given(st.from_regex(made, fullmatch=True))
    def take(text: str | bytes) -> None:
        found.append(text)

    take()
    text = found[0]
    return (text.decode("latin-1") if isinstance(text, bytes) else text)[:16]


@pytest.mark.fault(53)
@pytest.mark.fault(56)
def test_no_pattern_of_the_program_is_slower_than_its_text_is_long() -> None:
    found = patterns()
    assert len(found) > 60
    assert {"server/formats/calibrations/views.py", "server/store/folder.py"} <= {where for where, *_ in found}
    lines = [json.dumps([*one, _sample(one[1], one[2], one[3])]) for one in found]
    run = subprocess.Popen(
        [sys.executable, "-c", "import resource; resource.setrlimit(resource.RLIMIT_CPU, (120, 120))\n" + CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    said, _ = run.communicate("\n".join(lines))
    slow = [line for line in said.splitlines() if line.startswith("SLOW")]
    assert not slow, "\n".join(slow)
    assert run.returncode == 0, said.splitlines()[-1]


@pytest.mark.fault(53)
def test_titles_and_lines_have_a_longest_length() -> None:
    title = "a[" + 1200 * " " + "b)c"
    with pytest.raises(FileFormatError, match="at most 200") as caught:
        read_channel_table(f"time_s,{title}\n0,1\n1,2\n".encode())
    assert caught.value.code == "channels_unreadable"
    for content, read in ((b"time_s," + 70_000 * b"0" + b"\n0,1\n", read_channel_table), (70_000 * b"x", read_table)):
        with pytest.raises(FileFormatError, match="more than 65536 characters"):
            read(content)
    with pytest.raises(FileFormatError) as caught:
        read_table(f"x,y,z,u,v,{title}\n1,2,3,4,5,6\n".encode())
    assert caught.value.code == "model_unreadable"
    with pytest.raises(FileFormatError) as caught:
        parse_calibration(b"Cam0_Fx;1\n" + 20_000 * b" " + b"x\n", name="a")
    assert caught.value.code == "calibration_unreadable"


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("Force [kN]", "force_kn"),
        ("Force(kN)", "force_kn"),
        ("Force / kN", "force_kn"),
        ("Force  ( kN )", "force_kn"),
        ("Weg (axial) [mm]", "weg_axial_mm"),
        ("Force", "force"),
        ("a) b", "a_b"),
    ],
)
def test_a_unit_stands_behind_its_title(title: str, name: str) -> None:
    assert list(read_channel_table(f"t [s];{title}\n0;1\n1;2\n".encode()).channels) == [name]


@pytest.mark.parametrize("cell", ["1_000", "١٢", "1٫5"])
def test_digits_of_other_scripts_are_no_numbers(cell: str) -> None:
    table = read_channel_table(f"t,f,g\n0,1,1\n1,{cell},2\n2,3,3\n".encode())
    assert table.channels["f"].size == 3
    assert not (table.channels["f"] == 12).any()
    assert str(table.channels["f"][1]) == "nan"
