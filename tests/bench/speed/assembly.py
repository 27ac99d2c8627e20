"""What the compiler makes of the pixel loops, for processors that need not be at hand.

``python -m tests.bench.speed.assembly TARGET`` compiles the loops for ``NUMBA_CPU_NAME=TARGET`` (set by
:func:`inspect_target`, in a process of its own), takes the assembly, and counts the instructions of the innermost loop
over pixels. Nothing is run.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

from tests.support.requirements import ROOT

# numba takes this machine's features unless given others; the processor's name implies the rest
TARGETS = {
    "haswell": "+avx2,+fma",
    "znver3": "+avx2,+fma",
    "skylake-avx512": "+avx512f,+avx512vl",
    "sapphirerapids": "+avx512f,+avx512vl",
}
HERE = "this machine"
MAX_S = 300.0

# in this order; an instruction counts once. AT&T syntax: the destination comes last, memory is written with brackets
_CLASSES = (
    ("gathers", re.compile(r"^v?p?gather")),
    ("multiply-adds", re.compile(r"^vfn?m(add|sub)")),
    ("divides", re.compile(r"^v?(div|sqrt|rcp|rsqrt)")),
    (
        "row loads",
        re.compile(
            r"^v?(mov[uad]p[sd]|movdq[ua]\d*|lddqu|insert[fi]\S*|broadcast[fi](128|32x4|64x2)|movsd|movq|movhps|movhpd|movlps|perm\S*) (?!.*%rsp).*\(%.*%xmm|^v(insert[fi]\S+|broadcast[fi](128|32x4|64x2)) (?!.*%rsp).*\(%"
        ),
    ),
    ("multiplies, adds", re.compile(r"^v?(mul|add|sub)[ps][sd]")),
    ("rounds, converts", re.compile(r"^v?(round|rndscale|cvt)")),
    (
        "shuffles",
        re.compile(
            r"^v?p?(perm|shuf|unpck|blend|insert|extract|movddup|movs[lh]dup|movlhps|movhlps|broadcast|align|expand|compress)"
        ),
    ),
)


@dataclass(frozen=True)
class LoopCount:
    """Instructions of one turn of a pixel loop (eight pixels, one image).

    Attributes
    ----------
    target, loop
        Processor and name of the loop.
    width_bits
        Widest vector register that its multiply-adds use.
    instructions
        All of them.
    counts
        By class; an instruction counts once.
    stack
        Instructions that read or write the stack: spilled values, and constants of the loop that found no register.
    """

    target: str
    loop: str
    width_bits: int
    instructions: int
    counts: dict[str, int]
    stack: int


def innermost_loops(assembly: str) -> list[list[str]]:
    """Instructions of each innermost loop: from a label to a jump back to it with no other such jump between."""
    lines = [line.split("#")[0].strip().replace("\t", " ") for line in assembly.splitlines()]
    line_of = {line[:-1]: i for i, line in enumerate(lines) if line.endswith(":")}
    spans = []
    for i, line in enumerate(lines):
        jump = re.match(r"j\w+ (\.?\w+)$", line)
        if jump and line_of.get(jump[1], i) < i:
            spans.append((line_of[jump[1]], i))
    inner = [s for s in spans if not any(o != s and s[0] <= o[0] and o[1] <= s[1] for o in spans)]
    return [[x for x in lines[a : b + 1] if x and not x.endswith(":") and not x.startswith(".")] for a, b in inner]


def count_loop(target: str, name: str, assembly: str) -> LoopCount:
    """Count the loop with the most multiply-adds."""
    is_fma = dict(_CLASSES)["multiply-adds"]
    body = max(innermost_loops(assembly), key=lambda loop: sum(bool(is_fma.match(x)) for x in loop), default=[])
    if not any(is_fma.match(x) for x in body):
        raise RuntimeError(f"no loop with multiply-adds in {name} for {target}")
    counts: Counter[str] = Counter({label: 0 for label, _ in _CLASSES})
    for instruction in body:
        label = next((label for label, pattern in _CLASSES if pattern.match(instruction)), None)
        if label:
            counts[label] += 1
    arithmetic = " ".join(x for x in body if is_fma.match(x))
    width = 512 if "%zmm" in arithmetic else 256 if "%ymm" in arithmetic else 128
    stack = sum("(%rsp" in x for x in body)
    return LoopCount(target, name, width, len(body), dict(counts), stack)


def assemblies() -> dict[str, str]:
    """Compile the loops over pixels for the processor that numba was given, and return their assembly."""
    from numba import float32, float64, int64, njit, void

    from stereorig.core.matching.kernels.loops import compare_cubic, compare_quintic

    signature = void(float32[::1], int64, int64, float32[::1], float32[:, ::1], int64, float64[::1])

    def compiled(compare: Any) -> str:
        def loop(c, base, stride, warp, ref, blocks, out):  # type: ignore[no-untyped-def]
            compare(c, base, stride, warp, ref, blocks, out)

        dispatcher = njit(signature, nogil=True, error_model="numpy")(loop)
        return str(dispatcher.inspect_asm(dispatcher.signatures[0]))

    loops = {"cubic": compare_cubic[1], "quintic": compare_quintic[1], "cubic, curved patch": compare_cubic[2]}
    return {name: compiled(loop) for name, loop in loops.items()}


def inspect_target(target: str) -> list[LoopCount]:
    """Compile for one of :data:`TARGETS` or for :data:`HERE`, in a process of its own, and count."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if target != HERE:
        environment |= {"NUMBA_CPU_NAME": target, "NUMBA_CPU_FEATURES": TARGETS[target]}
    done = subprocess.run(
        [sys.executable, "-m", "tests.bench.speed.assembly", target],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        timeout=MAX_S,
        cwd=ROOT,
    )
    if done.returncode != 0:
        raise RuntimeError(f"compiling for {target} failed:\n{done.stderr[-2000:]}")
    return [LoopCount(**entry) for entry in json.loads(done.stdout.splitlines()[-1])]


def main() -> int:
    """Count for the processor of this process."""
    found = [count_loop(sys.argv[1], name, text) for name, text in assemblies().items()]
    print(json.dumps([asdict(entry) for entry in found]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
