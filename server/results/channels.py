"""What was recorded with a step: channels, load, and its time since the reference."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from server.formats.channel_units import unit_of
from server.formats.results.reading import read_head
from server.store.durable import known_json


@dataclass(frozen=True)
class Recorded:
    """What a step's record says beside its images.

    Attributes
    ----------
    channels
        Scalar readings by name.
    load_n
        Load in newtons; None where none was recorded.
    time_s
        Seconds since the reference; None where either time is not known, as of imported images without their own.
    """

    channels: Mapping[str, float] = field(default_factory=dict)
    load_n: float | None = None
    time_s: float | None = None


def recorded_with(home: Path, n: int, reference: int | None) -> Recorded:
    """Return what was recorded with a step; nothing for results of no test.

    Parameters
    ----------
    home
        Folder of the results, ``<test>/analyses/<id>`` or ``<test>/exports/measure``.
    n
        Number of the step.
    reference
        Of its reference; None: it is the reference.
    """
    steps = home.absolute().parent.parent / "steps"
    one = known_json(steps / f"{n:04d}" / "step.json") if steps.is_dir() else {}
    if not one:
        return Recorded()
    first = one if reference in (None, n) else known_json(steps / f"{reference:04d}" / "step.json")
    begin, end = step_time(first), step_time(one)
    channels = one.get("channels")
    return Recorded(
        {str(k): float(v) for k, v in channels.items()} if isinstance(channels, dict) else {},
        float(one["load_n"]) if isinstance(one.get("load_n"), int | float) else None,
        None if begin is None or end is None else (end - begin).total_seconds(),
    )


def has_more(result: Path, home: Path) -> bool:
    """Return True if a step's record has more than its result file: channels, or a load that came later."""
    head = read_head(result)
    recorded = recorded_with(home, head.step, head.reference_step)
    return bool(recorded.channels) or (recorded.load_n is not None and recorded.load_n != head.load_n)


def step_time(step: Mapping[str, object]) -> datetime | None:
    """Return when a step's images were taken: by the client's clock, else the service's; an import's is not known."""
    text = step.get("timestamp_utc") or (step.get("captured_utc") if step.get("source") != "import" else None)
    try:
        return datetime.fromisoformat(str(text)) if text else None
    except ValueError:
        return None


def units_of(names: Iterable[str]) -> dict[str, str]:
    """Return the unit of each channel, by its name."""
    return {name: unit_of(name) for name in sorted(names)}


def rising(times: Iterable[float | None]) -> list[float] | None:
    """Return times that are all known and rise from step to step; None otherwise."""
    held = list(times)
    known = [t for t in held if t is not None]
    ordered = len(known) == len(held) and all(a < b for a, b in itertools.pairwise(known))
    return known if ordered else None
