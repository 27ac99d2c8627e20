"""The cameras: their identity, their settings as taken, and the course of their frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.simultaneity import in_words, no_common_ptp
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.doctor.report import Notebook, State, percentile
from stereorig.server.results.images.quality import image_quality
from stereorig.server.rig.cameras import CameraPair, CapturedPair

#: relative difference of a setting that is the device's rounding; beyond it the device has another value
_ROUNDING = 0.01
_RATE_SHARE = 0.02
#: share of frames that may be lost before a sequence is not worth its name
_LOSS_SHARE = 0.01
#: without any good pair for this long the rest need not be waited for
_NO_PAIR_S = 3.0
_PASSING = {"skew_too_large", "frame_incomplete", "pair_incomplete", "no_frames"}

_QUALITY = {
    "dark": "The image is black: open the shutter, switch the lamp on, or expose longer.",
    "saturated": "Expose less, or lower the gain.",
    "blank": "The image shows nothing: check lens cap, focus and the scene before the camera.",
    "low_texture": "Nothing here could be matched: put a speckled specimen (or the grid) before the camera, and focus.",
    "blurred": "Focus the lens, or expose for a shorter time if something moves.",
}


_Count = TypeVar("_Count", int, float)


@dataclass
class PairLog:
    """Measurements while pairs were captured one after the other."""

    seconds: float = 0.0
    durations_ms: list[float] = field(default_factory=list)
    skews_ms: list[float] = field(default_factory=list)
    #: uncertainty and source of the largest of them
    skew_by: str = ""
    #: of them, those surely above the limit
    skews_refused: int = 0
    passing: dict[str, int] = field(default_factory=dict)
    last: CapturedPair | None = None
    frames: dict[CameraName, dict[str, int]] = field(default_factory=dict)
    account: dict[str, int] = field(default_factory=dict)
    link: dict[CameraName, dict[str, float]] = field(default_factory=dict)

    def skew(self, known: Mapping[str, Any]) -> None:
        """Take a pair's skew, with its uncertainty and source."""
        skew_ms = abs(known["skew_ms"])
        if skew_ms >= max(self.skews_ms, default=0.0):
            source, uncertainty_ms = known.get("skew_source", "clock"), known.get("skew_uncertainty_ms", 0.0)
            self.skew_by = in_words(source, uncertainty_ms)
        self.skews_ms.append(skew_ms)

    @property
    def pairs_per_s(self) -> float | None:
        """Pairs captured a second, or None if there was none."""
        return len(self.durations_ms) / self.seconds if self.durations_ms and self.seconds > 0 else None

    def bytes_per_s(self, cam: CameraName) -> float:
        """Bytes over the camera's link: as its driver counted, else by the images' size."""
        counted = self.link[cam].get("transferred_bytes")
        if counted is not None:
            return counted / self.seconds
        return 0.0 if self.last is None else self.announced(cam) * self.last.pixels[cam].nbytes / self.seconds

    def announced(self, cam: CameraName) -> int:
        """Advance of the camera's counter."""
        return sum(self.frames[cam][name] for name in ("delivered", "overrun", "dropped", "incomplete"))


def check_identity(book: Notebook, pair: CameraPair) -> None:
    """Note who each camera is; the same one twice cannot make a pair."""
    units = pair.units
    for cam in CAMERAS:
        who = units[cam].description
        columns, rows = who.image_size_px
        text = f"{who.model} {who.serial} ({who.driver}"
        book.note(
            cam,
            "identity",
            "ok",
            f"{text}{', firmware ' + who.firmware if who.firmware else ''}), sensor {columns} x {rows} px",
        )
    one, two = (units[cam].description for cam in CAMERAS)
    if one.serial and (one.driver, one.model, one.serial) == (two.driver, two.model, two.serial):
        book.note(
            "pairs",
            "identity",
            "failed",
            f"cam1 and cam2 are the same camera ({one.model} {one.serial})",
            remedy="Name two different devices in the rig file.",
        )


def check_settings(book: Notebook, unit: CameraUnit) -> None:
    """Compare the rig file's settings with the settings read back."""
    wanted = unit.wanted
    asked = {name: value for name, value in vars(wanted).items() if value is not None and name != "features"}
    asked |= {f"feature {name}": value for name, value in (wanted.features or {}).items()}
    has = {name: value for name, value in vars(unit.settings).items() if name != "features"}
    has |= {f"feature {name}": value for name, value in (unit.settings.features or {}).items()}
    same: list[str] = []
    other: list[str] = []
    for name, value in asked.items():
        got = has.get(name)
        (same if _agrees(value, got) else other).append(
            f"{name} {got}" if _agrees(value, got) else f"{name} {got} instead of {value}"
        )
    text = ", ".join([*other, *same]) or "none asked for"
    book.note(
        unit.name,
        "settings",
        "failed" if other else "ok",
        f"read back: {text}",
        remedy="The camera has other values than the rig file: put values there that it can take.",
    )


def _agrees(asked: Any, got: Any) -> bool:
    if isinstance(asked, bool) or isinstance(got, bool) or not isinstance(asked, int | float):
        return bool(asked == got)
    return isinstance(got, int | float) and abs(got - asked) <= _ROUNDING * abs(asked)


def watch(pair: CameraPair, seconds: float) -> PairLog:
    """Capture pairs for so long, at least one; count the errors that concern a single pair.

    Raises
    ------
    CameraError
        When a camera is lost.
    """
    seen = PairLog()
    _warm_up(pair)
    before = {cam: pair.units[cam].counters() for cam in CAMERAS}
    account = pair.account()
    link = {cam: _link(pair.units[cam]) for cam in CAMERAS}
    begin = time.monotonic()
    while not seen.durations_ms or time.monotonic() - begin < seconds:
        start = time.monotonic()
        try:
            seen.last = pair.capture(1)
        except CameraError as error:
            if error.code not in _PASSING or (not seen.durations_ms and start - begin > max(seconds, _NO_PAIR_S)):
                raise
            seen.passing[error.code] = seen.passing.get(error.code, 0) + 1
            if "skew_ms" in error.context:
                seen.skew(error.context)
                seen.skews_refused += 1
            continue
        seen.durations_ms.append(1e3 * (time.monotonic() - start))
        seen.skew(seen.last.skew)
    seen.seconds = time.monotonic() - begin
    seen.frames = {cam: _grown(pair.units[cam].counters(), before[cam]) for cam in CAMERAS}
    seen.account = _grown(pair.account(), account)
    seen.link = {cam: _grown(_link(pair.units[cam]), link[cam]) for cam in CAMERAS}
    return seen


def _warm_up(pair: CameraPair) -> None:
    """Take one pair that does not count: the first after arming is often late."""
    try:
        pair.capture(1)
    except CameraError as error:
        if error.code not in _PASSING:
            raise


def _link(unit: CameraUnit) -> dict[str, float]:
    return {name: float(value) for name, value in unit.statistics().items()}


def _grown(now: Mapping[str, _Count], before: Mapping[str, _Count]) -> dict[str, _Count]:
    return {name: value - before.get(name, 0) for name, value in now.items()}


def check_frames(book: Notebook, unit: CameraUnit, seen: PairLog) -> None:
    """Rates, losses and image of one camera."""
    cam = unit.name
    counts, announced = seen.frames[cam], seen.announced(cam)
    _check_rate(book, unit, announced, seen.seconds)
    lost = counts["dropped"] + counts["incomplete"]
    odd = {name: counts[name] for name in ("dropped", "incomplete", "duplicates", "out_of_order") if counts[name]}
    book.note(
        cam,
        "losses",
        _state_of_share(lost, announced) if lost or not odd else "warning",
        f"{announced} frames, " + (", ".join(f"{n} {name}" for name, n in odd.items()) or "none lost or damaged"),
        limit=f"1 frame or {100 * _LOSS_SHARE:g} %",
        remedy="Check cable, packet size, socket buffers and the load of link and processors (docs/how_to/cameras.md).",
        frames=announced,
        dropped=counts["dropped"],
        incomplete=counts["incomplete"],
        duplicates=counts["duplicates"],
    )
    if seen.last is None:
        return
    pixels = seen.last.pixels[cam]
    quality = image_quality(pixels, seen.last.bit_depth[cam])
    book.note(
        cam,
        "image",
        "ok" if quality.code == "ok" else "warning",
        f"{quality.code}: mean {quality.mean_grey:.0f} of {2 ** seen.last.bit_depth[cam] - 1}, "
        f"{100 * quality.saturated_share:.2f} % saturated, texture {quality.texture_grey_per_px:.1f} a px",
        remedy=_QUALITY.get(quality.code),
        mean_grey=quality.mean_grey,
        saturated_share=quality.saturated_share,
        texture_grey_per_px=quality.texture_grey_per_px,
        focus=quality.focus,
    )


def _check_rate(book: Notebook, unit: CameraUnit, announced: int, seconds: float) -> None:
    rate = announced / seconds
    wanted = None if unit.trigger == "software" else unit.rate_hz
    if wanted is None:
        book.note(unit.name, "frame rate", "ok", f"{rate:.2f} Hz ({unit.trigger} trigger)", rate_hz=rate)
        return
    # the first and last period are cut by the watch
    room = max(_RATE_SHARE * wanted, 1.5 / seconds)
    off = abs(rate - wanted)
    book.note(
        unit.name,
        "frame rate",
        "ok" if off <= room else "warning" if off <= 5 * room else "failed",
        f"{rate:.2f} Hz",
        limit=f"{wanted:g} Hz +- {room:.2g}",
        remedy="The camera does not reach its rate: expose for a shorter time, take a smaller region, or ask for less.",
        rate_hz=rate,
        wanted_hz=wanted,
    )


def check_ptp(book: Notebook, pair: CameraPair) -> None:
    """Note if both cameras follow one PTP master."""
    why = no_common_ptp({cam: pair.units[cam].description for cam in CAMERAS})
    book.note(
        "pairs",
        "ptp",
        "warning" if why else "ok",
        why or f"both follow {pair.units['cam1'].description.clock}",
        remedy="Connect both by a switch that passes PTP, and wait until they have settled.",
    )


def check_pairs(book: Notebook, seen: PairLog, config: RigConfig) -> None:
    """Skew, account and latency of the pairs."""
    limit = config.rig.skew_bound_ms
    if seen.skews_ms:
        worst = max(seen.skews_ms)
        # pairs between the captures are refused too, where frames come by themselves
        refused = max(seen.skews_refused, seen.account["refused"])
        book.note(
            "pairs",
            "skew",
            _state_of_share(refused, max(len(seen.skews_ms), seen.account["paired"])),
            f"median {statistics.median(seen.skews_ms):.3f} ms, worst {worst:.3f} ms over {len(seen.skews_ms)} pairs, "
            + seen.skew_by
            + (f"; {refused} refused" if refused else ""),
            limit=f"{limit:g} ms but for 1 or {100 * _LOSS_SHARE:g} %",
            remedy="Use a common hardware trigger (docs/how_to/triggers.md), or raise max_skew_ms "
            "for a specimen at rest.",
            median_ms=statistics.median(seen.skews_ms),
            worst_ms=worst,
            limit_ms=limit,
            refused=refused,
        )
    count = seen.account
    parts = ("paired", "unpaired", "incomplete", "dropped")
    adds_up = count["triggered"] == sum(count[name] for name in parts)
    lost = count["triggered"] - count["paired"]
    text = f"triggered {count['triggered']} = " + " + ".join(f"{count[name]} {name}" for name in parts)
    book.note(
        "pairs",
        "account",
        _state_of_share(lost, count["triggered"]) if adds_up else "failed",
        text if adds_up else f"does not add up: {text}",
        limit=f"1 or {100 * _LOSS_SHARE:g} % without a partner",
        remedy="Look at the losses above; check that one trigger reaches both cameras.",
        figures={name: float(count[name]) for name in ("triggered", *parts)},
    )
    if seen.durations_ms:
        p99 = percentile(seen.durations_ms, 0.99)
        book.note(
            "pairs",
            "latency",
            "ok",
            f"median {statistics.median(seen.durations_ms):.1f} ms, p99 {p99:.1f} ms from the request to both images",
            median_ms=statistics.median(seen.durations_ms),
            p99_ms=p99,
        )
        book.note(
            "pairs",
            "rate",
            "ok",
            f"{seen.pairs_per_s:.2f} pairs/s, {_mib_per_s(seen):.1f} MiB/s",
            pairs_per_s=seen.pairs_per_s,
            mib_per_s=_mib_per_s(seen),
        )


def _state_of_share(bad: int, of: int) -> State:
    """Return the state for a share of failures: one may fail, or one in a hundred."""
    return "ok" if bad == 0 else "warning" if bad <= max(1.0, _LOSS_SHARE * of) else "failed"


def _mib_per_s(seen: PairLog) -> float:
    if seen.last is None or seen.pairs_per_s is None:
        return 0.0
    return sum(pixels.nbytes for pixels in seen.last.pixels.values()) * seen.pairs_per_s / 2**20
