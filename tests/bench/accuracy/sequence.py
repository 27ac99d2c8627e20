"""Long sequences: total correlation, a reference that is updated where it fails, and incremental correlation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import MeasurementError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, PreviousStep, ReferencePair
from stereorig.core.settings import REFERENCE_UPDATES, ReferenceUpdate
from stereorig.sim.scene import Scene
from tests.bench.accuracy.paper_rig import BRIGHT, DARK, Rig, plane_scene, true_points, turn
from tests.bench.accuracy.table import Row, Section
from tests.bench.speed.scene import rig_of_size

SIZE_PX = (620, 580)
GRID = PointGrid.rectangle(206, 186, 414, 394, spacing_px=26)
OPTIONS = MeasureOptions(subset_px=33, patch="affine")
PX_UM = 39.0
NOISE = 2.0
STEPS = 24
SMALL_STEPS, SMALL_SEEDS = 21, 6
AFTER = (1, 2, 5, 20)
Z = np.array([0.0, 0.0, 1.0])
NAMES: dict[ReferenceUpdate, str] = {"never": "total", "auto": "auto", "always": "incremental"}
GREY = 0.5 * (DARK + BRIGHT)


@dataclass(frozen=True)
class _Motion:
    """A sequence: the scene of a step, and by how much its pattern has gone over to another one."""

    steps: int
    scene: Callable[[int], Scene]
    fading_deg: float = 0.0


@dataclass(frozen=True)
class _Followed:
    """Per step, over seeds and points: share valid, error rms and reported sigma rms of u, v, w in um, references used."""

    valid: Float
    error: Float
    reported: Float
    scatter: Float
    mean: Float
    updates: Float


def _motions(rig: Rig) -> dict[str, _Motion]:
    texture = rig.texture(3)

    def stretched(n: int) -> Scene:
        return plane_scene(texture, in_plane=np.diag([1.0 + n / STEPS, 1.0 - 0.2 * n / STEPS]))

    def turned(n: int) -> Scene:
        return plane_scene(texture, motion=turn(Z, np.deg2rad(180.0 * n / STEPS)))

    def moved(n: int) -> Scene:
        motion = replace(turn(Z, np.deg2rad(0.4 * n)), translation_mm=np.array([0.021, -0.013, 0.02]) * n)
        return plane_scene(texture, motion=motion)

    def small(n: int) -> Scene:
        motion = replace(
            turn(np.array([0.1, 0.05, 1.0]), np.deg2rad(0.4 * n)), translation_mm=np.array([0.021, -0.013, 0.02]) * n
        )
        return plane_scene(texture, in_plane=np.eye(2) + n * np.array([[4e-3, 1e-3], [0.0, -1.5e-3]]), motion=motion)

    return {
        "stretch to 100 %": _Motion(STEPS, stretched),
        "turn by 180 degrees": _Motion(STEPS, turned),
        "a pattern that fades": _Motion(STEPS, moved, 5.0),
        "small steps": _Motion(SMALL_STEPS, small),
    }


def _clean(rig: Rig, motion: _Motion) -> list[list[Float]]:
    out = []
    for n in range(motion.steps + 1):
        scene = motion.scene(n)
        pictures = [np.asarray(p, dtype=np.float64) for p in rig.capture(scene, noise=0.0)]
        if motion.fading_deg:
            a = np.deg2rad(motion.fading_deg * n)
            others = rig.capture(replace(scene, texture=rig.texture(4)), noise=0.0)
            pictures = [
                GREY + np.cos(a) * (p - GREY) + np.sin(a) * (q - GREY) for p, q in zip(pictures, others, strict=True)
            ]
        out.append(pictures)
    return out


def _expose(clean: list[Float], seed: int, n: int, noise: float) -> tuple[MeasureImage, MeasureImage]:
    if noise == 0.0:
        return MeasureImage(clean[0]), MeasureImage(clean[1])
    rng = np.random.default_rng([seed, n])
    one, two = (np.clip(np.round(c + rng.normal(0.0, noise, c.shape)), 0, 255).astype(np.uint8) for c in clean)
    return MeasureImage(one), MeasureImage(two)


def _measure(rig: Rig, clean: list[list[Float]], mode: ReferenceUpdate, seed: int, noise: float) -> list[Field | None]:
    """The fields of steps 1 to the last; None from where nothing was found."""
    pairs = [_expose(c, seed, n, noise) for n, c in enumerate(clean)]
    reference = ReferencePair(rig.pair, *pairs[0])
    fields: dict[int, Field] = {}
    sequence = reference.sequence(
        reference.shape(GRID, OPTIONS),
        GRID,
        OPTIONS,
        reference_update=mode,
        images_of=lambda k: pairs[k],
        field_of=lambda k: fields[k],
    )
    for n in range(1, len(pairs)):
        try:
            fields[n] = sequence.measure(pairs[n], None if n == 1 else PreviousStep(n - 1, fields[n - 1]))
        except MeasurementError:
            break
        if not fields[n].valid.any():
            break
    return [fields.get(n) for n in range(1, len(pairs))]


def _follow(
    rig: Rig, motion: _Motion, clean: list[list[Float]], mode: ReferenceUpdate, seeds: int, noise: float = NOISE
) -> _Followed:
    shape = (seeds, motion.steps, *GRID.shape, 3)
    error, sigma, reference = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros((seeds, motion.steps))
    start = motion.scene(0)
    truth = [true_points(start, motion.scene(n), rig.pair.cam1, GRID.xy_px)[1] for n in range(1, motion.steps + 1)]
    for seed in range(seeds):
        for k, field in enumerate(_measure(rig, clean, mode, seed, noise)):
            if field is None or field.uvw_mm is None:
                reference[seed, k] = np.nan
                continue
            error[seed, k] = 1e3 * (field.uvw_mm - truth[k])
            sigma[seed, k] = 1e3 * field.sigma_mm[..., 3:]
            reference[seed, k] = 0 if field.references is None else field.references.step
    changes = (np.diff(reference, axis=1, prepend=0.0) > 0).cumsum(axis=1)

    def rms(a: Float) -> Float:
        square, count = np.nansum(a**2, axis=(0, 2, 3)), np.isfinite(a).sum(axis=(0, 2, 3))
        return np.sqrt(np.where(count > 0, square, np.nan) / np.maximum(count, 1))

    known = np.isfinite(error).all(axis=(0, 4))
    scatter = np.full((motion.steps, 3), np.nan)
    if seeds > 1:
        for k in range(motion.steps):
            if known[k].any():
                scatter[k] = np.sqrt(np.mean(np.var(error[:, k][:, known[k]], axis=0, ddof=1), axis=0))
    count = np.maximum(np.isfinite(error).sum(axis=(0, 2, 3)), 1)
    return _Followed(
        valid=100.0 * np.isfinite(error[..., 0]).mean(axis=(0, 2, 3)),
        error=rms(error),
        reported=rms(sigma),
        scatter=scatter,
        mean=np.nansum(error, axis=(0, 2, 3)) / count,
        updates=changes.mean(axis=0),
    )


def updates(figures: Path) -> Section:
    """Follow each sequence in each way."""
    rig = rig_of_size(SIZE_PX)
    motions = _motions(rig)
    rows: list[Row] = []
    small = motions.pop("small steps")
    clean = _clean(rig, small)
    noisy, exact = (_follow(rig, small, clean, "always", *a) for a in ((SMALL_SEEDS, NOISE), (1, 0.0)))
    for n in AFTER:
        ratio = noisy.reported[n] / noisy.scatter[n]
        for name, value in zip("uvw", ratio, strict=True):
            rows.append(
                Row(f"reported over empirical sd of {name} after {n} update{'s' if n > 1 else ''}", float(value), "")
            )
    rows.append(
        Row("error without noise after 20 updates, u, v together, rms", float(np.hypot(*exact.error[20, :2])), "um")
    )
    rows.append(Row("error without noise, w, rms", float(exact.error[20, 2]), "um"))
    drift = 1e3 * np.hypot(*exact.error[20, :2]) / 20.0 / PX_UM
    rows.append(Row("drift per update, steps of 0.64 px all alike", float(drift), "thousandths of a px"))
    results: dict[str, dict[ReferenceUpdate, _Followed]] = {}
    for name, motion in motions.items():
        clean = _clean(rig, motion)
        results[name] = {mode: _follow(rig, motion, clean, mode, 1) for mode in REFERENCE_UPDATES}
        for mode, followed in results[name].items():
            last = int(np.flatnonzero(followed.valid > 0.0)[-1])
            rows.append(Row(f"{name}, {NAMES[mode]}: valid points in the last step", float(followed.valid[-1]), "%"))
            rows.append(
                Row(f"{name}, {NAMES[mode]}: references used after the first", float(followed.updates[last]), "")
            )
            error, reported = (np.linalg.norm(a[last]) for a in (followed.error, followed.reported))
            rows.append(
                Row(
                    f"{name}, {NAMES[mode]}: error in the last step that was measured ({last + 1}), rms",
                    float(error),
                    "um",
                )
            )
            rows.append(Row(f"{name}, {NAMES[mode]}: reported over true error there", float(reported / error), ""))
    _draw(figures / "accuracy_updates.png", results)
    return Section(
        "Long sequences and later references",
        f"The modern rig with {SIZE_PX[0]} x {SIZE_PX[1]} px, a speckled plane, 33 px, {GRID.x_px.size} points, noise 2. "
        f"Small steps: {SMALL_STEPS} steps of 0.64 px, 0.4 degrees and 0.4 % each, each matched against the one before, "
        f"{SMALL_SEEDS} times with new noise. The others: {STEPS} steps, once; a pattern that fades goes over to another "
        "one by 5 degrees of a quarter turn in each step, after 18 steps nothing is left of it. Errors of u, v and w are taken together.",
        rows,
        [("accuracy_updates.png", "Valid points, error and reported error step by step: total, auto, incremental")],
        [
            "The noise of a step's images moves a point one way when the step is measured and the other way when it is the reference: "
            "it cancels, and 20 updates cost little. What does not cancel adds up: interpolation's bias, the same in each step if "
            "the steps are alike (it is not part of the reported error), and a change of the pattern itself, which draws points along in total correlation too.",
            "At 100 % stretch a subset of the first reference covers 66 px, and those at the border leave the image; that is no reason for auto to update. In the "
            "fading pattern the points that auto lacks were refused before a reference failed, and came back against none: older ones match nothing.",
        ],
    )


def _draw(path: Path, results: dict[str, dict[ReferenceUpdate, _Followed]]) -> None:
    figure, axes = plt.subplots(3, len(results), figsize=(10, 7), layout="constrained", sharex=True)
    colours = {"never": "tab:blue", "auto": "tab:orange", "always": "tab:green"}
    styles = {"never": "-", "auto": "--", "always": ":"}
    for column, (name, modes) in enumerate(results.items()):
        for mode, f in modes.items():
            steps = np.arange(1, len(f.valid) + 1)
            error, reported = (np.linalg.norm(a, axis=1) for a in (f.error, f.reported))
            style = {"color": colours[mode], "ls": styles[mode], "lw": 2.0, "label": NAMES[mode]}
            for row, values in enumerate((f.valid, error, reported / error)):
                axes[row, column].plot(steps, values, **style)
        axes[0, column].set(title=name, ylim=(-5, 105))
        axes[2, column].set(xlabel="step", ylim=(0, 3))
        axes[2, column].axhline(1.0, color="0.7", lw=0.8, zorder=0)
    for row, label in enumerate(("valid points, %", "error of u, v, w, rms, um", "reported over true error")):
        axes[row, 0].set_ylabel(label)
    axes[0, 0].legend()
    figure.savefig(path, dpi=64)
    plt.close(figure)
