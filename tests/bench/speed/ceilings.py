"""What this machine can do at best, measured now: float32 arithmetic, memory and cache bandwidth, gathers, row loads.

Small loops in LLVM IR, compiled for this processor by the LLVM that compiles our kernels too. Each runs on one thread or
on several at once (a call holds no lock); the figure is all threads' together. The loops:

- ``fma``: independent multiply-adds on registers, as many chains as hide their latency;
- ``load``: whole vectors from a buffer that fits L1, L2 or L3;
- ``gather``: the sixteen taps of a cubic spline for eight neighbouring pixels, one gather instruction a tap;
- ``rows``: the same taps as four unaligned loads of four values a pixel, each with a multiply-add.

``copy`` and ``triad`` go through main memory, by numpy.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import llvmlite.binding as llvm
import numpy as np

_COLUMNS = 256  # of the picture that gathers and row loads read: eight rows and their taps stay in L1
_INDICES = 1024
_MIN_S = 0.03
_REPEATS = 5

Kernel = Callable[[int, int, int, int], float]


@dataclass(frozen=True)
class Ceilings:
    """The machine's limits on one number of threads, all of them together; NaN for what it cannot do.

    Attributes
    ----------
    threads
        Threads at work at once.
    vector
        float32 values in the vector registers used.
    fma_gflops
        1e9 operations a second; a multiply-add counts two.
    load_gb_s
        GB/s from ``L1``, ``L2``, ``L3``.
    copy_gb_s, triad_gb_s
        GB/s read and written in main memory.
    gather_ns, rows_ns
        ns a pixel of sixteen taps.
    """

    threads: int
    vector: int
    fma_gflops: float
    load_gb_s: dict[str, float]
    copy_gb_s: float
    triad_gb_s: float
    gather_ns: float
    rows_ns: float


def vector_width() -> int:
    """float32 values in the widest vector register of this processor."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 16
    return 8 if features.get("avx") else 4


def _splat(kind: str, value: float, n: int) -> str:
    return f"<{', '.join([f'{kind} {value}'] * n)}>"


def _function(name: str, width: int, chains: int, step: int, body: str, *, entry: str = "", declare: str = "") -> str:
    """A loop over i = 0, step ... n with ``chains`` vector sums c0 -> d0 ...; returns their total.

    ``body`` may use i, ``j`` = i & mask, the pointers index and data; ``{k}`` in a line repeats it for every chain.
    """
    v = f"<{width} x float>"
    ones = _splat("float", 1.0, width)
    phis = "\n".join(f"  %c{k} = phi {v} [{ones}, %entry], [%d{k}, %loop]" for k in range(chains))
    lines = []
    for line in body.strip().splitlines():
        lines += [line.replace("{k}", str(k)) for k in range(chains)] if "{k}" in line else [line]
    total = "\n".join(f"  %s{k} = fadd {v} {'%d0' if k == 1 else f'%s{k - 1}'}, %d{k}" for k in range(1, chains))
    return f"""{declare}
define float @{name}(i64 %n, i64 %mask, ptr %index, ptr %data) {{
entry:
{entry}
  br label %loop
loop:
  %i = phi i64 [0, %entry], [%next, %loop]
{phis}
  %j = and i64 %i, %mask
{chr(10).join(lines)}
  %next = add i64 %i, {step}
  %more = icmp slt i64 %next, %n
  br i1 %more, label %loop, label %done
done:
{total}
  %r = call float @llvm.vector.reduce.fadd.v{width}f32(float 0.0, {v} %s{chains - 1})
  ret float %r
}}
declare float @llvm.vector.reduce.fadd.v{width}f32(float, {v})
"""


def fma_ir(width: int) -> str:
    v = f"<{width} x float>"
    return _function(
        "fma",
        width,
        12,
        1,
        f"  %d{{k}} = call {v} @llvm.fma.v{width}f32({v} %c{{k}}, {v} %a, {v} %a)",
        entry=f"  %a = load {v}, ptr %data, align 4",
        declare=f"declare {v} @llvm.fma.v{width}f32({v}, {v}, {v})",
    )


def load_ir(width: int) -> str:
    v, chains = f"<{width} x float>", 8
    body = "\n".join(
        f"  %o{k} = add i64 %j, {k * width}\n  %q{k} = getelementptr float, ptr %data, i64 %o{k}\n"
        f"  %x{k} = load {v}, ptr %q{k}, align 64\n  %d{k} = fadd {v} %c{k}, %x{k}"
        for k in range(chains)
    )
    return _function("load", width, chains, chains * width, body)


def gather_ir() -> str:
    v, vi, every = "<8 x float>", "<8 x i32>", _splat("i32", -1, 8)
    body = [f"  %q = getelementptr i32, ptr %index, i64 %j\n  %x = load {vi}, ptr %q, align 4"]
    for k in range(16):
        offset = _splat("i32", (k // 4) * _COLUMNS + k % 4, 8)
        body.append(
            f"  %y{k} = add {vi} %x, {offset}\n"
            f"  %g{k} = call {v} @llvm.x86.avx2.gather.d.ps.256({v} zeroinitializer, ptr %data, {vi} %y{k}, {v} %all, i8 4)"
        )
    # eight sums for sixteen taps, or the sums alone would spill
    body += [f"  %m{k} = fadd {v} %g{k}, %g{k + 8}\n  %d{k} = fadd {v} %c{k}, %m{k}" for k in range(8)]
    return _function(
        "gather",
        8,
        8,
        8,
        "\n".join(body),
        entry=f"  %all = bitcast {vi} {every} to {v}",
        declare=f"declare {v} @llvm.x86.avx2.gather.d.ps.256({v}, ptr, {vi}, {v}, i8)",
    )


def rows_ir() -> str:
    v, pixels = "<4 x float>", 8
    body = []
    for k in range(pixels):
        body.append(
            f"  %e{k} = add i64 %j, {k}\n  %q{k} = getelementptr i32, ptr %index, i64 %e{k}\n"
            f"  %x{k} = load i32, ptr %q{k}, align 4\n  %z{k} = zext i32 %x{k} to i64\n"
            f"  %p{k} = getelementptr float, ptr %data, i64 %z{k}"
        )
        for row in range(4):
            before, after = (f"%c{k}" if row == 0 else f"%h{k}_{row - 1}"), (f"%d{k}" if row == 3 else f"%h{k}_{row}")
            body.append(
                f"  %a{k}_{row} = getelementptr float, ptr %p{k}, i64 {row * _COLUMNS}\n"
                f"  %l{k}_{row} = load {v}, ptr %a{k}_{row}, align 4\n"
                f"  {after} = call {v} @llvm.fma.v4f32({v} %l{k}_{row}, {v} %w, {v} {before})"
            )
    return _function(
        "rows",
        4,
        pixels,
        pixels,
        "\n".join(body),
        entry=f"  %w = load {v}, ptr %data, align 4",
        declare=f"declare {v} @llvm.fma.v4f32({v}, {v}, {v})",
    )


class CompiledLoop:
    """One loop, compiled for this processor; keeps its engine alive."""

    def __init__(self, name: str, text: str) -> None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3, jit=True
        )
        module = llvm.parse_assembly(text)
        module.verify()
        self._engine = llvm.create_mcjit_compiler(module, machine)
        self._engine.finalize_object()
        signature = ctypes.CFUNCTYPE(ctypes.c_float, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)
        self.call: Kernel = signature(self._engine.get_function_address(name))


def _aligned(n: int) -> np.ndarray:
    raw = np.zeros(n + 32, dtype=np.float32)
    start = (-raw.ctypes.data // 4) % 16
    out = raw[start : start + n]
    out[:] = 0.5
    return out


def _per_second(work: list[Callable[[int], object]], unit: int) -> float:
    """Items a second of workers that each do ``n`` items when called, all at once; best of some runs."""
    n = unit
    while True:
        start = time.perf_counter()
        work[0](n)
        if time.perf_counter() - start > _MIN_S:
            break
        n *= 2
    best = 0.0
    with ThreadPoolExecutor(len(work)) as pool:
        for _ in range(_REPEATS):
            start = time.perf_counter()
            for future in [pool.submit(one, n) for one in work]:
                future.result()
            best = max(best, n * len(work) / (time.perf_counter() - start))
    return best


def _rate(kernel: Kernel, threads: int, *, floats: int, mask: int, unit: int) -> float:
    """Values of i that the loop passes a second."""
    columns = np.arange(_INDICES) % 200
    rows = np.arange(_INDICES) // 200
    index = (rows * _COLUMNS + columns).astype(np.int32)
    data = [_aligned(floats) for _ in range(threads)]

    def worker(own: np.ndarray) -> Callable[[int], object]:
        return lambda n: kernel(n, mask, index.ctypes.data, own.ctypes.data)

    return _per_second([worker(own) for own in data], unit)


def measure_ceilings(threads: int) -> Ceilings:
    """Measure all limits on ``threads`` threads at once; some seconds."""
    width = vector_width()
    fma = CompiledLoop("fma", fma_ir(width))
    load = CompiledLoop("load", load_ir(width))
    rows = CompiledLoop("rows", rows_ir())
    flops = 2 * 12 * width * _rate(fma.call, threads, floats=64, mask=0, unit=1 << 16)
    loads = {}
    for level, kib in (("L1", 16), ("L2", 256), ("L3", 4096)):
        n = kib * 256
        loads[level] = 4e-9 * _rate(load.call, threads, floats=n, mask=n - 1, unit=1 << 20)
    picture = 16 * _COLUMNS
    rows_rate = _rate(rows.call, threads, floats=picture, mask=_INDICES - 1, unit=1 << 16)
    gather_rate = float("nan")
    if llvm.get_host_cpu_features().get("avx2"):
        gather = CompiledLoop("gather", gather_ir())
        gather_rate = _rate(gather.call, threads, floats=picture, mask=_INDICES - 1, unit=1 << 14)
    copy, triad = _main_memory(threads)
    return Ceilings(threads, width, flops * 1e-9, loads, copy, triad, 1e9 / gather_rate, 1e9 / rows_rate)


def _main_memory(threads: int) -> tuple[float, float]:
    """GB/s of a copy (read and written) and of ``a = b + c``, on arrays far larger than the caches."""
    n = 1 << 24
    a, b, c = (np.ones(n * threads, dtype=np.float32) for _ in range(3))

    def copier(k: int) -> Callable[[int], object]:
        own = slice(k * n, (k + 1) * n)
        return lambda _: np.copyto(a[own], b[own])

    def adder(k: int) -> Callable[[int], object]:
        own = slice(k * n, (k + 1) * n)
        return lambda _: np.add(b[own], c[own], out=a[own])

    rates = []
    for make, streams in ((copier, 2), (adder, 3)):
        work = [make(k) for k in range(threads)]
        best = 0.0
        with ThreadPoolExecutor(threads) as pool:
            for _ in range(_REPEATS):
                start = time.perf_counter()
                for future in [pool.submit(one, n) for one in work]:
                    future.result()
                best = max(best, 4e-9 * streams * n * threads / (time.perf_counter() - start))
        rates.append(best)
    return rates[0], rates[1]
