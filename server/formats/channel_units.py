"""Units of channels: a channel's name ends in its unit (``force_kn``), so that it travels with every number."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable

#: what ends a name, and the unit as it is written
_UNITS = {
    "n": "N",
    "kn": "kN",
    "nm": "N m",
    "pa": "Pa",
    "kpa": "kPa",
    "mpa": "MPa",
    "gpa": "GPa",
    "bar": "bar",
    "um": "um",
    "mm": "mm",
    "cm": "cm",
    "m": "m",
    "mm_s": "mm/s",
    "mm_min": "mm/min",
    "um_m": "um/m",
    "s": "s",
    "ms": "ms",
    "min": "min",
    "hz": "Hz",
    "c": "degC",
    "k": "K",
    "v": "V",
    "mv": "mV",
    "ma": "mA",
    "deg": "deg",
    "rad": "rad",
    "percent": "%",
}
_WRITTEN = {unit.lower().replace(" ", ""): ending for ending, unit in _UNITS.items()}
_WRITTEN |= {
    "°c": "c",
    "c": "c",
    "µm": "um",
    "μm": "um",
    "µm/m": "um_m",
    "n/mm²": "mpa",
    "n/mm2": "mpa",
    "n/mm^2": "mpa",
}
_WRITTEN |= {"sec": "s", "seconds": "s", "n*m": "nm", "n·m": "nm", "µε": "um_m", "microstrain": "um_m", "°": "deg"}


def unit_of(name: str) -> str:
    """Return the unit that a channel's name ends in, as NetCDF writes it; ``1`` where it ends in none."""
    parts = name.lower().split("_")
    for count in (2, 1):
        ending = "_".join(parts[-count:])
        if len(parts) > count and ending in _UNITS:
            return _UNITS[ending]
    return "1"


def channel_name(title: str, unit: str = "") -> str:
    """Return a channel's name for a column's title and unit: ``Force`` and ``kN`` make ``force_kn``."""
    name = _word(title) or "channel"
    ending = _WRITTEN.get(unit.strip().lower().replace(" ", ""), _word(unit))
    return (name if not ending or name.endswith(f"_{ending}") else f"{name}_{ending}")[:100]


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


def _word(text: str) -> str:
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "_", plain.replace("%", " percent ")).strip("_")
