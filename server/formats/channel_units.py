"""Units of channels: as a record states them, else as a channel's name ends in one (``force_kn``)."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable

from stereorig.core.errors import InputError

#: ends of a channel's name that state its unit. ``nm`` is N m here: a record's own unit is kept with its channel
_UNITS = {"nm": "N m", "c": "degC", "k": "K", "v": "V", "mv": "mV", "ma": "mA", "percent": "%", "hz": "Hz"}
_FORCES = "N kN cN daN lbf klbf kip kgf"
_UNITS |= {one.lower(): one for one in f"{_FORCES} Pa kPa MPa GPa bar psi ksi".split()}
_LENGTHS = "um mm cm m"
_UNITS |= {one.replace("/", "_"): one for one in f"{_LENGTHS} mm/s mm/min um/m s ms min deg rad".split()}
#: newtons (CODATA and NIST SP 811: the pound and the standard gravity are exact)
FORCE_N = {
    **{"N": 1.0, "kN": 1e3, "MN": 1e6, "GN": 1e9, "mN": 1e-3, "uN": 1e-6, "cN": 1e-2, "daN": 10.0, "dyn": 1e-5},
    **{"lbf": 4.4482216152605, "lb": 4.4482216152605, "ozf": 0.2780138509537812},
    **{"kip": 4448.2216152605, "klbf": 4448.2216152605, "kgf": 9.80665, "gf": 9.80665e-3, "tf": 9806.65},
}
TIME_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0, "d": 86400.0}
#: other spellings of a unit, without blanks and signs of a product
_SPELLINGS = {
    "s": "sec secs second seconds sek sekunde sekunden seconde secondes segundos secondi seg sn 秒 с сек",
    "ms": "msec millisecond milliseconds мс",
    "min": "mins minute minutes minuten minutos мин 分",
    "h": "hr hrs hour hours std stunden heures horas ч",
    "d": "days",
    "N": "newton newtons Н",
    "kN": "kilonewton kilonewtons кН",
    "daN": "даН",
    "lb": "lbs",
    "lbf": "pound pounds poundforce poundsforce",
    "kip": "kips",
    "kgf": "kp кгс",
    "tf": "tonf тс",
    "in": 'inch inches zoll pouce pollici "',
    "mil": "mils thou",
    "mm": "millimeter millimeters millimetre millimetres мм",
    "cm": "см",
    "degC": "C ℃",
    "degF": "℉",
    "MPa": "N/mm2 МПа",
    "um": "micron microns мкм",
    "um/m": "ue uε microstrain ustrain",
    "N m": "Nm",
    "N mm": "Nmm",
    "kN m": "kNm",
    "lbf in": "lbfin inlbf inlb lbin",
    "lbf ft": "lbfft ftlbf ftlb lbft",
}
_PLAIN = """uA mA A uV mV V mV/V Hz kHz deg rad K kg g % mm/mm m/m in/in mm/m nm um mm cm m in mil ft Pa hPa kPa MPa GPa
bar mbar psi ksi Msi kgf/mm2 kgf/cm2 mm/s mm/min um/s m/s in/s in/min %/s %/min 1/s N/s kN/s kN/min MPa/s N/mm kN/mm"""
_WRITTEN = {one: one for one in (*FORCE_N, *TIME_S, *_PLAIN.split(), *_SPELLINGS)}
_WRITTEN |= {one: unit for unit, others in _SPELLINGS.items() for one in others.split()}
_SIGNS = str.maketrans(
    {**dict.fromkeys(" .·⋅∙*×^-_\u00a0"), "µ": "u", "μ": "u", "²": "2", "³": "3", "°": "deg", "º": "deg"}
)
#: in any letter case, if that leaves one unit only: MN is not mN, and nm not N m
_ANY_CASE: dict[str, set[str]] = {}
for _one, _unit in _WRITTEN.items():
    _ANY_CASE.setdefault(_one.lower(), set()).add(_unit)
_LONGEST_UNIT = 40
_CHANNELS = ("ch ", "ch.", "channel", "kanal", "canal", "sensor", "dev", "ai", "slot", "mod")


def known_unit(written: str) -> str | None:
    """Return a unit in the program's spelling; None if it is not known, or is one of two as ``NM``."""
    plain = written.strip().translate(_SIGNS)
    if plain == "mN" and "mN" not in written:  # metre times newton, as m·N
        return "N m"
    found = _ANY_CASE.get(plain.lower(), set())
    return _WRITTEN.get(plain) or (next(iter(found)) if len(found) == 1 else None)


def stated_unit(written: str) -> str:
    """Return a unit in the program's spelling, as written if it is not known; empty for none."""
    plain = "".join(c if c.isprintable() else " " for c in written).strip()
    return known_unit(plain) or ("" if plain in ("-", "1") else plain[:_LONGEST_UNIT])


def newtons_of(name: str, recorded: Iterable[str], stated: str | None) -> float:
    """Return the newtons of a channel's unit.

    Parameters
    ----------
    name
        The channel.
    recorded, stated
        Units that its record has in the steps, ``1`` for none; and the unit to take without one.

    Raises
    ------
    InputError
        ``load_unit`` if that is no force.
    """
    units = set(recorded) - {"1"}
    written = units.pop() if len(units) == 1 else stated
    unit = None if written is None or units else known_unit(written)
    if unit not in FORCE_N:
        raise InputError(
            f"The channel {name!r} is in {written or 'no stated unit'}, which is no force.",
            code="load_unit",
            remedy="Name another channel, or state load_unit, as kN.",
        )
    return FORCE_N[unit]


def unit_of(name: str) -> str:
    """Return the unit that a channel's name ends in, as NetCDF writes it; ``1`` if it ends in none."""
    return _parted(name)[1]


def channel_title(name: str, unit: str | None = None) -> str:
    """Return a channel's name and unit as a figure shows them: ``pressure_kpa`` is ``pressure, kPa``.

    Parameters
    ----------
    unit
        Unit that the channel's record states; None: the one that its name ends in.
    """
    stem, ending = _parted(name)
    unit = unit or ending
    title = (stem if unit == ending else name).replace("_", " ")
    return title if unit == "1" else f"{title}, {unit}"


def _parted(name: str) -> tuple[str, str]:
    """Return a channel's name without the unit that it ends in, and that unit, ``1`` for none."""
    parts = name.split("_")
    for count in (2, 1):
        ending = "_".join(parts[-count:]).lower()
        if len(parts) > count and ending in _UNITS:
            return "_".join(parts[:-count]), _UNITS[ending]
    return name, "1"


def channel_name(title: str, unit: str = "") -> str:
    """Return a channel's name for a column's title and unit: ``Force`` and ``kN`` make ``force_kn``."""
    name = _word(title) or "channel"
    known = known_unit(unit) or unit
    ending = {"degC": "c", "degF": "f", "N m": "nm"}.get(known) or _word(known)
    return (name if not ending or name.endswith(f"_{ending}") else f"{name}_{ending}")[:100]


def titled_unit(title: str) -> tuple[str, str]:
    """Return a title without the unit that it states, and that unit as written: ``Force [kN]``, ``Force in kN``.

    A title such as ``Force_MN`` keeps its ending, which is its unit in the letters of the file.
    """
    parted = title_and_unit(title, "[(/")
    if parted is not None and parted[1].lower().startswith(_CHANNELS) and parted[0].endswith((")", "]")):
        before = title_and_unit(parted[0], "[(")  # a channel may be named after the unit: Force (kN) [Ch 2]
        parted = (f"{before[0]} {parted[1]}", before[1]) if before and known_unit(before[1]) else parted
    if parted is not None and (title[len(parted[0]) :].lstrip()[:1] != "/" or known_unit(parted[1])):
        return parted
    for mark in (" in ", ", ", ","):
        name, found, unit = title.rpartition(mark)
        if found and known_unit(unit):
            return name.strip(), unit
    ending = title.replace("_", " ").rpartition(" ")[2]
    mixed = ending.translate(_SIGNS) in _WRITTEN and (len(ending) > 1 or "_" in title) and not title.islower()
    mixed = mixed and ending.lower() != "min"  # of a peak and its valley
    return title, ending if mixed else ""


#: longest title of a column, and longest line of a table
MAX_TITLE, MAX_LINE = 200, 1 << 16


def title_and_unit(title: str, openings: str) -> tuple[str, str] | None:
    """Return a title's name and the unit after it, as in ``Force [kN]``, without the marks; None if it has no unit.

    Parameters
    ----------
    openings
        The characters that a unit may begin with.
    """
    end = len(title) - title.endswith((")", "]"))
    inner = max(title.rfind(")", 0, end), title.rfind("]", 0, end))
    begin = min((k for k in (title.find(mark, inner + 1, end) for mark in openings) if k >= 0), default=-1)
    return None if begin < 0 else (title[:begin].rstrip(), title[begin + 1 : end].strip())


def plain_names(names: Iterable[str], plain: Callable[[str], str] | None = None) -> dict[str, str]:
    """Return for each channel a name that programs take: letters, digits, underscores; no two alike.

    Parameters
    ----------
    plain
        Makes a name plain in a program's own way.
    """
    found: dict[str, str] = {}
    for name in names:
        made = re.sub(r"[^A-Za-z0-9_]+", "_", name) if plain is None else plain(name)
        while made in found.values():
            made += "_"
        found[name] = made
    return found


def ascii_of(text: str) -> str:
    """Return a text without accents and without letters of other scripts."""
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()


def folded(text: str) -> str:
    """Return a text in small letters without accents."""
    return ascii_of(text).lower()


def _word(text: str) -> str:
    plain = re.sub(r"[^a-z0-9]+", "_", folded(text).replace("%", " percent ")).strip("_")
    # a title in another script keeps its letters
    return plain or re.sub(r"\W+", "_", unicodedata.normalize("NFKC", text).lower()).strip("_")
