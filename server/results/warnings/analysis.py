"""Warnings of an analysis: failed checks, points that are missing, inputs that changed, each with its remedy."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stereorig.server.base.json_values import Keep, nothing
from stereorig.server.formats.calibrations.in_test import calibration_id_in, calibration_in, measured_with
from stereorig.server.formats.manifest import DamagedError
from stereorig.server.formats.results.camera_motion import MOVED_REMEDY
from stereorig.server.store.durable import UnchangedFiles, known_json

Level = Literal["failed", "warning"]
_Summary = Mapping[str, Any]
_Steps = Mapping[int, _Summary]

#: share of the region's points with values below which a step warns, and fails
COVERAGE_WARNING, COVERAGE_FAILED = 0.8, 0.5
#: entries of steps, measured and captured, that are asked for here: some thousand steps are not held for the others
_ASKED_FOR = frozenset(
    {"n", "epipolar_check", "valid_fraction", "valid", "points", "status", "camera_motion", "quality", "warnings"}
)
#: of the steps of an analysis that runs all but the newest are as they were when they were asked for last
_STEPS = UnchangedFiles(2_000)
#: steps that a warning names one by one
_NAMED = 100
_QUALITY = {
    "saturated": "an image is too bright: whole speckles are at full scale",
    "dark": "an image is too dark",
    "blank": "an image shows nothing but noise",
    "low_texture": "an image has too little texture",
    "blurred": "an image is blurred",
}


@dataclass(frozen=True)
class ResultWarning:
    """A reason for which a result is not to be used as it is.

    Attributes
    ----------
    code
        Stable name.
    level
        ``failed``: no number of it should be reported. ``warning``: with care.
    text
        The finding with its figures, in a sentence.
    remedy
        Advice to the user.
    steps
        Steps that it holds for; empty: the whole analysis.
    """

    code: str
    level: Level
    text: str
    remedy: str
    steps: tuple[int, ...] = ()

    def plain(self) -> dict[str, object]:
        """Return it as plain values."""
        plain: dict[str, object] = {
            "code": self.code,
            "level": self.level,
            "text": self.text,
            "remedy": self.remedy,
            "steps": list(self.steps[:_NAMED]),
        }
        return plain if len(self.steps) <= _NAMED else {**plain, "n_steps": len(self.steps)}


def analysis_warnings(
    folder: Path, *, stale: Sequence[str] = (), failed: Mapping[str, object] | None = None
) -> list[ResultWarning]:
    """Return the warnings of an analysis, failed checks first.

    Parameters
    ----------
    folder
        Folder of its results; in a test's folder, or alone.
    stale
        Inputs that are gone or were replaced since.
    failed
        Steps that could not be measured, by their numbers; as ``summary.json`` has them if left out.
    """
    found = {int(one["n"]): one for one in _own_summaries(folder)}
    summary = _known(folder / "summary.json", {"steps": nothing if found else _used})
    found = found or {int(one["n"]): one for one in summary.get("steps") or [] if isinstance(one.get("n"), int)}
    home = folder.parent.parent if (folder.parent.parent / "steps").is_dir() else None
    taken = {} if home is None else {n: _step_in(home / "steps" / f"{n:04d}" / "step.json") for n in found}
    problems = failed if failed is not None else summary.get("steps_failed")
    made = [
        *_epipolar(found),
        *_off_zero(taken),
        *_coverage(found),
        *([] if home is None else _calibration(home, measured_with(folder))),
        *_moved(found),
        *_failed_steps(problems if isinstance(problems, dict) else {}),
        *_quality(taken or found),
        *_stale(stale),
    ]
    return sorted(made, key=lambda one: one.level != "failed")


def _known(path: Path, keep: Mapping[str, Keep] | None = None) -> dict[str, Any]:
    """Return a document; empty without one, and for one that is damaged, which is among the reasons to be stale."""
    try:
        return known_json(path, keep)
    except DamagedError:
        return {}


def _used(step: object) -> _Summary:
    """Return the entries of a step that are asked for here."""
    found = step if isinstance(step, dict) else {}
    return {name: value for name, value in found.items() if name in _ASKED_FOR}


def _read_step(path: Path) -> _Summary:
    return _used(_known(path))


def _step_in(path: Path) -> _Summary:
    """Return the entries of a file of one step that are asked for here."""
    return _STEPS.made_of(path, _read_step)


def _own_summaries(folder: Path) -> Iterable[_Summary]:
    """Yield the summaries that the service stores with each step's result."""
    there = set(os.listdir(folder)) if folder.is_dir() else set()  # noqa: PTH208 - names of some thousand files
    for name in sorted(there):
        if name.startswith("step_") and name.endswith(".json") and f"{name[:-5]}.nc" in there:
            found = _step_in(folder / name)
            if isinstance(found.get("n"), int):
                yield found


def _of(numbers: Sequence[int]) -> str:
    """Name steps in a sentence's beginning."""
    if len(numbers) == 1:
        return f"Step {numbers[0]}"
    listed = ", ".join(map(str, numbers)) if len(numbers) <= 8 else f"{numbers[0]} ... {numbers[-1]}"
    return f"{len(numbers)} steps ({listed})"


def _worst(steps: _Steps, value: Callable[[_Summary], float | None]) -> tuple[int, _Summary]:
    return max(steps.items(), key=lambda item: value(item[1]) or 0.0)


def _epipolar(steps: _Steps) -> list[ResultWarning]:
    checked = {n: one["epipolar_check"] for n, one in steps.items() if isinstance(one.get("epipolar_check"), dict)}
    bad = {n: one for n, one in checked.items() if one.get("level") in ("failed", "warning")}
    if not bad:
        return []
    level: Level = "failed" if any(one["level"] == "failed" for one in bad.values()) else "warning"
    n, worst = _worst(bad, lambda one: one.get("offset_px"))
    text = f"{_of(sorted(bad))}: the epipolar check {'failed' if level == 'failed' else 'warns'}; step {n}: "
    remedy = (
        "Take no number from this analysis. Take the cameras back to their calibrated place and capture again, or "
        "calibrate again and repeat the measurement."
        if level == "failed"
        else "Check that no camera was touched; hold later steps against the reference, or calibrate again."
    )
    return [
        ResultWarning(f"epipolar_check_{level}", level, f"{text}{worst.get('reason')}.", remedy, tuple(sorted(bad)))
    ]


def _off_zero(taken: _Steps) -> list[ResultWarning]:
    off = {n: one for n, one in taken.items() if (one.get("quality") or {}).get("code") == "cameras_off_zero"}
    if not off:
        return []
    first = next((str(one["warnings"][0]) for one in off.values() if one.get("warnings")), "")
    where = f": {first.split('. POST')[0]}" if first else ""
    return [
        ResultWarning(
            "cameras_off_zero",
            "failed",
            f"{_of(sorted(off))}: the cameras were off their calibrated place{where}.",
            "Take the cameras back to dZ = 0 (Rig, stage), then capture and measure again.",
            tuple(sorted(off)),
        )
    ]


def _coverage(steps: _Steps) -> list[ResultWarning]:
    share = {n: one["valid_fraction"] for n, one in steps.items() if isinstance(one.get("valid_fraction"), int | float)}
    low = {n: steps[n] for n, value in share.items() if value < COVERAGE_WARNING}
    if not low:
        return []
    n = min(low, key=lambda n: share[n])
    level: Level = "failed" if share[n] < COVERAGE_FAILED else "warning"
    states = {k: v for k, v in (low[n].get("status") or {}).items() if k not in ("ok", "extrapolated", "masked")}
    most = max(states, key=lambda k: states[k]).replace("_", " ") if states else ""
    why = f", most of the others: {most}" if most else ""
    text = (
        f"{_of(sorted(low))}: few points have values; step {n}: {low[n].get('valid')} of {low[n].get('points')} "
        f"({100.0 * share[n]:.0f} %){why}."
    )
    remedy = (
        "See the field status for the reasons; draw the region on the specimen alone, or improve pattern and light."
    )
    return [ResultWarning("low_coverage", level, text, remedy, tuple(sorted(low)))]


def _calibration(home: Path, sha256: str | None) -> list[ResultWarning]:
    name = calibration_id_in(_known(home / "test.json"), sha256) or ""
    made = []
    folder = home.parent.parent / "calibrations" / Path(name).name
    review = _known(folder / "review.json")
    if name and review.get("decision") == "discarded":
        note = f": {review['note']}" if review.get("note") else ""
        made.append(
            ResultWarning(
                "calibration_discarded",
                "failed",
                f"The calibration {name} was discarded{note}.",
                "Measure with another calibration, or take the decision back.",
            )
        )
    with contextlib.suppress(DamagedError):  # that its calibration is gone is among the reasons to be stale
        return made + _verdict(_known(calibration_in(home, sha256)).get("verdict"), review)
    return made


def _verdict(verdict: object, review: Mapping[str, Any]) -> list[ResultWarning]:
    """Return the warning that follows from a calibration's own verdict."""
    made: list[ResultWarning] = []
    found = verdict.get("level") if isinstance(verdict, dict) else None
    accepted = review.get("decision") == "accepted"  # by someone who saw the verdict
    if isinstance(verdict, dict) and (found == "failed" or (found == "warning" and not accepted)):
        reasons = " ".join(map(str, verdict.get("reasons") or []))
        made.append(
            ResultWarning(
                f"calibration_{found}",
                "failed" if found == "failed" and not accepted else "warning",
                f"The calibration's own verdict is {found}{': ' + reasons.rstrip('.') if reasons else ''}.",
                "Calibrate again; the calibration's page lists the faults to put right.",
            )
        )
    return made


def _moved(steps: _Steps) -> list[ResultWarning]:
    moved = {n: m for n, one in steps.items() if (m := one.get("camera_motion")) and m.get("camera_moved")}
    if not moved:
        return []
    last = max(moved)
    text = f"{_of(sorted(moved))}: a camera moved; step {last}: {moved[last].get('text')}."
    return [ResultWarning("camera_moved", "warning", text, MOVED_REMEDY, tuple(sorted(moved)))]


def _failed_steps(failed: Mapping[str, object]) -> list[ResultWarning]:
    numbers = sorted(int(n) for n in failed)
    if not numbers:
        return []
    first = failed[str(numbers[0])]
    cause = str(first.get("detail", "")).rstrip(".") if isinstance(first, dict) else ""
    remedy = str(first.get("remedy") or "") if isinstance(first, dict) else ""
    text = f"{_of(numbers)} could not be measured; step {numbers[0]}: {cause}."
    return [ResultWarning("steps_failed", "warning", text, remedy or "Read each step's problem.", tuple(numbers))]


def _quality(taken: _Steps) -> list[ResultWarning]:
    bad = {n: c for n, one in taken.items() if (c := (one.get("quality") or {}).get("code")) in _QUALITY}
    if not bad:
        return []
    n = min(bad)
    return [
        ResultWarning(
            "image_quality",
            "warning",
            f"{_of(sorted(bad))}: {_QUALITY[bad[n]]} (step {n}).",
            "Put exposure, light, focus or pattern right and capture again; see the step's figures.",
            tuple(sorted(bad)),
        )
    ]


def _stale(reasons: Sequence[str]) -> list[ResultWarning]:
    if not reasons:
        return []
    text = f"Out of date: {'; '.join(reasons)}."
    return [ResultWarning("out_of_date", "warning", text, "Restore the files from a backup, or measure again.")]
