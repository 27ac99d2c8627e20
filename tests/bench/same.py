"""Compare the results of this checkout with those of another commit, bit for bit.

    python -m tests.bench.same 7f3798b4

Renders small scenes once, measures and calibrates them by the command line of both commits, and prints each variable
and document that differs. Ends with 1 if any does.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from stereorig.core.names import CAMERAS
from stereorig.server.formats.images import write_image
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from tests.support.board_views import rig_views, write_views
from tests.support.requirements import ROOT

BUILD = ROOT / "build" / "same"
# names of values that differ from run to run, or name the program
_VARYING = re.compile(
    r"(?i)seconds|_s$|time|date|created|measured_at|program|version|commit|threads|host|folder|path|cwd|sha256|^file$"
)
_MOMENT = re.compile(rb"20[0-9]{2}-[0-9]{2}-[0-9]{2}T[0-9:.]+(Z|[+-][0-9:]+)?")
_LOADS = {"block": (0.0, 0.5, 1.0), "panel": (0.0, 20.0), "sphere": (0.0, 0.3), "strip": (0.0, 0.2, 0.4)}
# OpenCV's start of free poses rounds otherwise from process to process
_STARTED_BY_OPENCV = {"sim_board.json": 1e-6}
_STILL = 4
# sums of several threads round otherwise from run to run
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def small_rig() -> SimRig:
    """Return the paper's rig with small sensors."""
    tables = tomllib.loads((ROOT / "config" / "sim_paper.toml").read_text())
    width, height = 230, 200
    for name in CAMERAS:
        tables[name]["image_size_px"] = [width, height]
        tables["sim"][name] |= {"cx_px": width / 2 + 3.0, "cy_px": height / 2 - 2.0}
    return SimRig.from_dict(tables)


def render_inputs(folder: Path) -> None:
    """Write images of each scene, the true calibration, and views of a line grid and of a board into a folder."""
    rig = small_rig()
    rng = np.random.default_rng(1)

    def expose(into: Path, n: int, scene: str, load: float) -> None:
        into.mkdir(parents=True, exist_ok=True)
        state = make_scene(rig, scene, load=load)
        for name in CAMERAS:
            sim = rig.camera(name)
            seen = render(state, sim.camera, sim.size_px, options=RenderOptions(blur_px=rig.blur_px, threads=1))
            write_image(into / f"{name}_{n}.tif", sim.sensor.expose(sim.lighting.apply(seen), rng, exposure=1.0))

    for scene, loads in _LOADS.items():
        for n, load in enumerate(loads):
            expose(folder / scene, n, scene, load)
    for n in range(_STILL):
        expose(folder / "still", n, "block", 0.0)
    cameras = {name: rig.camera(name).camera.paper_parameters() for name in CAMERAS}
    (folder / "calibration.json").write_text(json.dumps(cameras))
    for name, hand, travels in (("sim_paper", (), (0.0, 2.5, 5.0)), ("sim_board", range(8), ())):
        own = SimRig.from_toml(ROOT / "config" / f"{name}.toml")
        views = rig_views(own, hand=hand, travels_mm=travels)
        moves = own.stage.moves if travels else "free"
        write_views(folder / name, views, own.target, [own.cam1.camera, own.cam2.camera], moves=moves)


def commands(inputs: Path, out: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the arguments of each command, in an order in which each finds its inputs."""

    def measure(name: str, scene: str, *more: str, pairs: int | None = None) -> tuple[str, list[str]]:
        files = [sorted(str(path) for path in (inputs / scene).glob(f"{cam}_*.tif"))[:pairs] for cam in CAMERAS]
        roi = [] if "--roi" in more else ["--roi", "50,45,180,155"]
        calibration = [] if "--calibration" in more else ["--calibration", str(inputs / "calibration.json")]
        given = ["measure", "--cam1", *files[0], "--cam2", *files[1], *calibration, *roi, "--subset", "21"]
        return name, [*given, *more, "--out", str(out / name)]

    yield measure("shape", "block", pairs=1)
    yield measure("sequence", "block", "--reference-update", "always", "--strain", "5")
    yield measure("kept", "strip", "--keep-rejected", "--strain-tensor", "hencky", "--smooth", "5")
    yield measure("crack", "panel", "--crack", "50,100,115,100", "--strain", "5", "--dense", "4")
    yield measure("curved", "sphere", "--patch", "quadratic", "--strain", "5", "--strain-order", "2")
    yield measure("projected", "block", "--projected", "--interpolation", "cubic", "--prefilter", "0.6")
    still = [[str(inputs / "still" / f"{cam}_{n}.tif") for n in range(_STILL)] for cam in CAMERAS]
    noise = str(out / "noise.json")
    yield "noise", ["noise", "--cam1", *still[0], "--cam2", *still[1], "--out", noise]
    yield measure("noisy", "block", "--noise", noise)
    opencv = str(out / "opencv.yml")
    yield "convert", ["calibration", "convert", str(inputs / "calibration.json"), opencv, "--to", "opencv"]
    yield measure("imported", "block", "--calibration", opencv, pairs=2)
    for name, hold_out in (("sim_paper", "2.5"), ("sim_board", "0,4")):
        views = inputs / name
        given = ["calibrate", str(views), "--target", str(views / "target.toml"), "--rig", str(views / "rig.toml")]
        yield name, [*given, "--hold-out", hold_out, "--out", str(out / f"{name}.json")]
    gauges = ["--extensometer", "60,60,160,60", "--line", "60,60,160,140", "--area", "all", "--point", "100,100"]
    yield "gauge", ["gauge", str(out / "sequence"), *gauges, "--align", "plane", "--out", str(out / "gauge.json")]
    yield "csv", ["export", str(out / "sequence"), "--format", "csv", "--out", str(out / "csv")]


def run(checkout: Path, inputs: Path, out: Path) -> None:
    """Run each command by the code of a checkout; write its exit status and output beside its results."""
    before = _kernels(checkout)
    _run_once(checkout, inputs, out)
    if _kernels(checkout) != before:  # a kernel rounds otherwise in the process that compiles it
        print("  again, with the kernels that were compiled", flush=True)
        _run_once(checkout, inputs, out)


def _kernels(checkout: Path) -> set[str]:
    return {str(path) for package in ("core", "sim") for path in (checkout / package).rglob("*.nbc")}


def _run_once(checkout: Path, inputs: Path, out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    package = "stereorig.server" if (checkout / "stereorig" / "server").exists() else "server"  # before decision 59
    for name, arguments in commands(inputs, out):
        done = subprocess.run(
            [sys.executable, "-m", f"{package}.cli", *arguments],
            cwd=checkout,
            env={**os.environ, "PYTHONPATH": str(checkout), **dict.fromkeys(_ONE_THREAD, "1")},
            capture_output=True,
            text=True,
            check=False,
        )
        (out / f"{name}.txt").write_text(f"{done.returncode}\n{done.stdout}", encoding="utf-8")
        print(f"  {name}: {done.returncode} {done.stderr.strip()[-200:] if done.returncode else ''}", flush=True)


def plain(document: Any) -> Any:
    """Return a document without the values that vary from run to run."""
    if isinstance(document, dict):
        return {key: plain(value) for key, value in document.items() if not _VARYING.search(key)}
    return [plain(one) for one in document] if isinstance(document, list) else document


def document_differences(old: Any, new: Any, where: str = "", rounding: float = 0.0) -> Iterator[str]:
    """Yield each place at which two documents differ, numbers by more than a relative ``rounding``."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            if key in old and key in new:
                yield from document_differences(old[key], new[key], f"{where}.{key}", rounding)
            else:
                yield f"{where}.{key}: {'gone' if key in old else 'new'}"
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for n, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from document_differences(one, other, f"{where}[{n}]", rounding)
    elif isinstance(old, float) and isinstance(new, float):
        if not (math.isclose(old, new, rel_tol=rounding, abs_tol=1e-6 * rounding) or (old != old and new != new)):
            yield f"{where}: {old!r} -> {new!r}"
    elif old != new:
        yield f"{where}: {str(old)[:100]} -> {str(new)[:100]}"


def in_groups(found: Iterable[str]) -> Iterator[str]:
    """Yield the first difference of each place, with the number of those at its other indexes."""
    groups: dict[str, list[str]] = {}
    for text in found:
        groups.setdefault(re.sub(r"\[[0-9]+\]", "[]", text.partition(": ")[0]), []).append(text)
    for texts in groups.values():
        yield texts[0] + (f"  (and {len(texts) - 1} like it)" if len(texts) > 1 else "")


def field_differences(old: Path, new: Path) -> Iterator[str]:
    """Yield each variable and attribute of two result files that differs."""
    with xr.open_dataset(old) as one, xr.open_dataset(new) as other:
        for name in sorted({str(key) for key in (*one.variables, *other.variables)}):
            if name not in one.variables or name not in other.variables:
                yield f"{name}: {'gone' if name in one.variables else 'new'}"
                continue
            a, b = one[name].values, other[name].values
            if a.shape == b.shape and a.tobytes() == b.tobytes():
                continue
            if a.shape == b.shape and np.issubdtype(a.dtype, np.number):
                unequal = ~((a == b) | ((a != a) & (b != b)))
                if unequal.any():
                    apart = np.nanmax(np.abs(a.astype(float) - b)[unequal], initial=0.0)
                    yield f"{name}: {int(unequal.sum())} of {a.size} values, by {apart:.3g} at most"
            else:
                yield f"{name}: shape or type {a.shape} {a.dtype} -> {b.shape} {b.dtype}"

        def attributes(data: xr.Dataset) -> dict[str, Any]:
            found = {str(k): v for k, v in data.attrs.items()}
            return {k: json.loads(v) if isinstance(v, str) and v[:1] in ("{", "[") else v for k, v in found.items()}

        yield from document_differences(plain(attributes(one)), plain(attributes(other)), "attributes")


def differences(old: Path, new: Path) -> Iterator[str]:
    """Yield each difference of two folders of results."""
    names = {path.relative_to(root).as_posix() for root in (old, new) for path in root.rglob("*") if path.is_file()}
    for name in sorted(names):
        one, other = old / name, new / name
        if not (one.exists() and other.exists()):
            yield f"{name}: {'gone' if one.exists() else 'new'}"
        elif one.suffix == ".nc":
            yield from (f"{name}: {text}" for text in field_differences(one, other))
        elif one.suffix == ".json":
            was, is_now = (plain(json.loads(path.read_text())) for path in (one, other))
            rounding = _STARTED_BY_OPENCV.get(name, 0.0)
            yield from (f"{name}{text}" for text in document_differences(was, is_now, rounding=rounding))
        elif one.suffix in (".csv", ".txt", ".yml"):
            pairs = ((one, old), (other, new))
            texts = [_MOMENT.sub(b"", path.read_bytes().replace(str(root).encode(), b"")) for path, root in pairs]
            if texts[0] != texts[1]:
                lines = [text.decode(errors="replace").splitlines() for text in texts]
                first = next((n for n, (a, b) in enumerate(zip(*lines, strict=False)) if a != b), min(map(len, lines)))
                yield f"{name}: line {first + 1} is {' -> '.join(repr(''.join(text[first : first + 1])[:90]) for text in lines)}"


def main() -> int:
    """Compare, print and return 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", help="commit to compare with")
    base = subprocess.run(
        ["git", "rev-parse", "--verify", f"{parser.parse_args().base}^{{commit}}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    inputs = BUILD / "inputs"
    if not (inputs / "calibration.json").exists():
        render_inputs(inputs)
    checkout = BUILD / base[:12]
    if not checkout.exists():
        subprocess.run(["git", "worktree", "add", "--detach", str(checkout), base], cwd=ROOT, check=True)
    for name, code in (("old", checkout), ("new", ROOT)):
        print(f"{name}: {code}", flush=True)
        run(code, inputs, BUILD / name)
    found = list(in_groups(differences(BUILD / "old", BUILD / "new")))
    print("\n".join(found) or "no difference")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
