"""Values recorded with a step: channels, load, and its time since the reference."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from stereorig.server.formats.channel_units import unit_of
from stereorig.server.formats.results.reading import read_head
from stereorig.server.store.durable import known_json


@dataclass(frozen=True)
class Recorded:
    """Channels, load and time that are recorded with a step's images.

    Attributes
    ----------
    channels
        Scalar readings by name.
    units
        Unit of each, as a load frame's record stated it, else as its name ends.
    u
        Standard uncertainty of those that the rig file names.
    load_n
        Load in newtons; None if none was recorded.
    time_s
        Seconds since the reference; None if either time is not known, as with imported images without times.
    """

    channels: Mapping[str, float] = field(default_factory=dict)
    load_n: float | None = None
    time_s: float | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    u: Mapping[str, float] = field(default_factory=dict)


def recorded_with(home: Path, n: int, reference: int | None) -> Recorded:
    """Return the values recorded with a step; empty for results that belong to no test.

    Parameters
    ----------
    home
        Folder of the results, ``<test>/analyses/<id>`` or ``<test>/exports/measure``.
    n
        Number of the step.
    reference
        Number of its reference; None: it is the reference.
    """
    steps = home.absolute().parent.parent / "steps"
    one = known_json(steps / f"{n:04d}" / "step.json") if steps.is_dir() else {}
    if not one:
        return Recorded()
    first = one if reference in (None, n) else known_json(steps / f"{reference:04d}" / "step.json")
    begin, end = step_time(first), step_time(one)
    channels = _numbers(one.get("channels"))
    return Recorded(
        channels,
        float(one["load_n"]) if isinstance(one.get("load_n"), int | float) else None,
        None if begin is None or end is None else (end - begin).total_seconds(),
        units_of(channels, one.get("channel_units")),
        _numbers(one.get("channel_u")),
    )


def _numbers(found: object) -> dict[str, float]:
    return {str(k): float(v) for k, v in found.items()} if isinstance(found, dict) else {}


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


def units_of(names: Iterable[str], stated: object = None) -> dict[str, str]:
    """Return the unit of each channel by its name: as a record stated it, else as the name ends."""
    known = stated if isinstance(stated, dict) else {}
    return {name: str(known.get(name) or unit_of(name)) for name in sorted(names)}


def rising(times: Iterable[float | None]) -> list[float] | None:
    """Return times that are all known and rise from step to step; None otherwise."""
    held = list(times)
    known = [t for t in held if t is not None]
    ordered = len(known) == len(held) and all(a < b for a, b in itertools.pairwise(known))
    return known if ordered else None
