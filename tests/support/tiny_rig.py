"""The tiny simulated rig, config/sim_tiny.toml, with lines of it replaced."""

from __future__ import annotations

from tests.support.requirements import ROOT

TINY = (ROOT / "config" / "sim_tiny.toml").read_text(encoding="utf-8")


def tiny_rig(**replacements: str) -> str:
    """Return the file's text with lines replaced, wherever they are (``velocity_mm_s="velocity_mm_s = 1.0"``)."""
    lines = TINY.splitlines()
    known = {line.split(" =")[0] for line in lines}
    if missing := set(replacements) - known:
        raise ValueError(f"the tiny rig has no {sorted(missing)}")
    return "\n".join(replacements.get(line.split(" =")[0], line) for line in lines) + "\n"
