"""config/sim_board.toml with half the pixels: a board in the hand, rendered in a fifth of the time."""

from __future__ import annotations

from tests.support.requirements import ROOT

SMALL_BOARD = (
    (ROOT / "config" / "sim_board.toml")
    .read_text(encoding="utf-8")
    .replace("[1224, 1024]", "[612, 512]")
    .replace("phd_px = 2000.0", "phd_px = 1000.0")
    .replace("fx_px = 2006.0", "fx_px = 1003.0")
    .replace("fy_px = 2007.0", "fy_px = 1003.5")
    .replace("fx_px = 1995.0", "fx_px = 997.5")
    .replace("fy_px = 1995.5", "fy_px = 997.8")
    .replace("cx_px = 618.3", "cx_px = 308.9")
    .replace("cy_px = 505.9", "cy_px = 252.7")
    .replace("cx_px = 605.1", "cx_px = 302.3")
    .replace("cy_px = 519.2", "cy_px = 259.3")
)
