"""The programs beside which the bench measures ours: where each is installed, what runs it, and its settings."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.support.requirements import ROOT


@dataclass(frozen=True)
class Setting:
    """One way of running a peer.

    Attributes
    ----------
    options
        Go to its script as they are.
    says
        What it is, for the page.
    only
        (scene, kind of run) where it is measured: at 33 px, with all threads, in the long form; None: everywhere.
    """

    name: str
    options: dict[str, Any]
    says: str
    only: tuple[tuple[str, str], ...] | None = None


@dataclass(frozen=True)
class Peer:
    """A program to compare with.

    Attributes
    ----------
    name, package
        As the page and as pip call it.
    extra
        Of ``pyproject.toml``; its environment is ``.venv-<extra>``.
    module
        What can be imported where it is installed.
    script
        In this folder; runs in the peer's environment.
    variable
        Environment variable that names another interpreter.
    compared
        The setting that ratios are taken to.
    owner
        How rows call it.
    about
        What a reader must know of it.
    spacing_px
        Distance of its own points where it cannot take ours; None: it measures ours.
    asked
        Least ratio of speeds by (scene, kind of run).
    built
        Built from sources instead of installed: ``variable`` names its program, and its script runs in our interpreter.
    """

    name: str
    package: str
    extra: str
    module: str
    script: str
    variable: str
    settings: tuple[Setting, ...]
    compared: str
    owner: str
    about: str
    spacing_px: int | None = None
    asked: dict[tuple[str, str], float] = field(default_factory=dict)
    built: bool = False

    @property
    def environment(self) -> Path:
        """Folder of its environment."""
        return ROOT / f".venv-{self.extra}"

    @property
    def how_to_install(self) -> str:
        """What to do where it is missing."""
        if self.built:
            return f"{self.name} is not built here: the head of opencorr_bench.cpp says how; {self.variable} names the program"
        return f"{self.name} is not installed: `make bench` installs {self.package} into {self.environment.name}"

    def interpreter(self) -> Path | None:
        """Return the interpreter that has it, or None: the one that ``variable`` names, its environment's, this one."""
        named = os.environ.get(self.variable)
        if self.built:
            return Path(sys.executable) if named and Path(named).is_file() else None
        for candidate in [Path(named)] if named else [self.environment / "bin" / "python", Path(sys.executable)]:
            if candidate.exists():
                with tempfile.TemporaryDirectory() as elsewhere:  # pyvale leaves a log file where it is imported
                    command = [str(candidate), "-c", f"import {self.module}"]
                    probe = subprocess.run(command, capture_output=True, check=False, cwd=elsewhere)
                if probe.returncode == 0:
                    return candidate
        return None


PYVALE = Peer(
    name="pyvale",
    package="pyvale",
    extra="bench",
    module="pyvale.dic",
    script="run_pyvale.py",
    variable="STEREORIG_BENCH_PEER",
    settings=(
        Setting(
            "tuned",
            {"max_displacement": 16},
            "16 px as the largest displacement to look for, which makes its first search fast; everything else its default "
            "(cubic B-spline, Gaussian filter of 5 px with sd 1, precision 0.001)",
        ),
        Setting("default", {}, "all its defaults (128 px to look for)", (("modern", "single"),)),
        Setting("loose", {"max_displacement": 16, "precision": 0.01}, "precision 0.01", (("paper", "sequence"),)),
        Setting(
            "unfiltered",
            {"max_displacement": 16, "image_filter_kernel": 1},
            "without its Gaussian filter",
            (("paper", "sequence"),),
        ),
    ),
    compared="tuned",
    owner="the peer's",
    about="`dic.calculate_3d` on the same points. It is given its seed. Its subsets move by an affine function, which leaves out "
    'the second order of perspective, ours as planes in space. In the table of targets "the peer" is pyvale.',
    asked={("modern", "single"): 10.0, ("modern", "sequence"): 30.0, ("paper", "single"): 5.0},
)

_SEED = {"init_guess": "seed"}
ALDIC = Peer(
    name="al-dic-3d",
    package="al-dic-3d",
    extra="bench-aldic",
    module="al_dic_3d.cli",
    script="run_aldic.py",
    variable="STEREORIG_BENCH_ALDIC",
    settings=(
        Setting(
            "local",
            {**_SEED, "use_global_step": False},
            "one seed, and subsets by themselves, without the global step: its fastest sensible setting",
        ),
        Setting(
            "global",
            _SEED,
            "one seed and the global step, which makes the subsets' displacements agree with a finite-element field",
            (("modern", "single"), ("paper", "single"), ("paper", "sequence")),
        ),
        Setting(
            "default",
            {},
            "all its defaults: the global step, and first guesses by search instead of a seed; on the smaller scene alone, since the "
            "search for camera 2's picture reaches 48 px, less than the other's disparity",
            (("paper", "single"),),
        ),
    ),
    compared="local",
    owner="al-dic-3d's",
    about="pyALDIC-3D, `al-dic-3d run` without a window, from image files to its archive. Its default strategy (`track_both`) matches "
    "the cameras at the reference alone, by subsets; then it tracks each camera over time, camera 2 on a grid of its own, and "
    "interpolates that field at the matched points. Its subsets are as wide as ours, but its nodes are its own: their "
    "distance must be a power of two, 8 px for our 10, and they lie centred in the same region, so points a second "
    "count more and nearer points. Errors are against the truth at its nodes. Subsets move by affine functions through a bicubic "
    "kernel without a prefilter, whose bias is in its means, and iterations end at a hundredth of a pixel. Points are lost "
    "only to its check of tracks (ZNSSD over 1): its quality gate (ZNSSD, reprojection, outliers) is off by default, and off here.",
    spacing_px=8,
)
OPENCORR = Peer(
    name="OpenCorr",
    package="",
    extra="",
    module="",
    script="run_opencorr.py",
    variable="STEREORIG_BENCH_OPENCORR",
    settings=(
        Setting(
            "guided",
            {},
            "starts from SIFT features at the reference and the first step, then from the step before; precision 0.001, at "
            "most 10 iterations",
        ),
    ),
    compared="guided",
    owner="OpenCorr's",
    about="a C++ library that no registry (PyPI, Debian, npm) has: it is measured where somebody has built it from its sources, by a "
    "program that goes its example of stereo DIC's way, each call a process of its own. Subsets move by second-order functions from camera to camera, "
    "by affine ones over time; positions are in single precision.",
    built=True,
)
PEERS = (PYVALE, ALDIC, OPENCORR)
