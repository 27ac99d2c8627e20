"""What is measured on each scene: our runs, and those of a peer. The first run of each only warms the process up."""

from __future__ import annotations

from tests.bench.speed.peers.programs import Peer
from tests.bench.speed.peers.runs import Run

WARM = "warm-up"
OURS = {
    "cubic": {"interpolation": "cubic"},
    "cubic+strain": {"interpolation": "cubic", "strain": 9},
    "quintic": {"interpolation": "quintic"},
}


def steps_of(scene: str, *, all_threads: bool, quick: bool) -> int:
    """Steps of a sequence."""
    return 2 if quick else 3 if scene == "modern" and not all_threads else 6


def own_runs(scene: str, *, all_threads: bool, quick: bool) -> list[Run]:
    """Ours, each as one step and as a sequence."""
    steps = steps_of(scene, all_threads=all_threads, quick=quick)
    runs = [Run(f"{WARM} {name}", 33, 1, options) for name, options in OURS.items()]
    for subset in (33, 21) if all_threads else (33,):
        for name, options in OURS.items():
            runs += [_run(name, kind, subset, steps, options, repeats=2) for kind in ("single", "sequence")]
    return runs


def peer_runs(peer: Peer, scene: str, *, all_threads: bool, quick: bool) -> list[Run]:
    """A peer's: the compared setting as ours, others where they say."""
    steps = steps_of(scene, all_threads=all_threads, quick=quick)
    runs = [Run(f"{WARM} {s.name}", 21, 1, s.options) for s in peer.settings if s.name == peer.compared]
    for subset in (33, 21) if all_threads else (33,):
        for setting in peer.settings:
            for kind in ("single", "sequence"):
                here = all_threads and subset == 33 and not quick and (scene, kind) in (setting.only or ())
                if setting.only is None or here:
                    runs.append(_run(setting.name, kind, subset, steps, setting.options))
    return runs


def _run(name: str, kind: str, subset: int, steps: int, options: dict[str, object], *, repeats: int = 1) -> Run:
    single = kind == "single"
    return Run(
        f"{name} {kind}{'' if single else f' of {steps}'}, {subset} px",
        subset,
        1 if single else steps,
        options,
        repeats,
    )
