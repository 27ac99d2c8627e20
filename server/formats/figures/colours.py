"""Colour maps: matplotlib's by their names, and the page's own two."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.colors import ListedColormap

from stereorig.core.arrays import Float

_ENTRIES = 256


def colour_map(name: str, levels: int = 0, *, reverse: bool = False) -> ListedColormap:
    """Return 256 colours; with ``levels`` above 1 so many bands of equal width.

    Parameters
    ----------
    name
        One of :data:`stereorig.server.formats.figures.options.COLOURS`.
    levels
        Number of bands; 0 and 1: smooth.
    reverse
        True: the first colour belongs to the largest values.
    """
    share = np.linspace(0.0, 1.0, _ENTRIES)
    if levels > 1:
        share = np.minimum(np.arange(_ENTRIES) * levels // _ENTRIES, levels - 1) / (levels - 1)
    if reverse:
        share = 1.0 - share
    own = {"diverging": _diverging, "grey": _grey}.get(name)
    colours = mpl.colormaps[name](share)[:, :3] if own is None else own(share)
    return ListedColormap(colours, name=name)


def _diverging(share: Float) -> Float:
    """Blue over light grey to brown: lightness and chroma change evenly from the middle."""
    t = 2.0 * share - 1.0
    hue = np.radians(np.where(t < 0.0, 258.0, 45.0))
    size = np.abs(t)
    return _ok_lab(0.95 - 0.55 * size, 0.135 * size * np.cos(hue), 0.135 * size * np.sin(hue))


def _grey(share: Float) -> Float:
    return _ok_lab(0.12 + 0.86 * share, np.zeros_like(share), np.zeros_like(share))


def _ok_lab(lightness: Float, a: Float, b: Float) -> Float:
    """Return (n, 3) sRGB, 0 to 1, of OKLab colours (Ottosson 2020)."""
    roots = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.291485548 * b,
        ],
        axis=-1,
    )
    to_linear = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.707614701],
        ]
    )
    linear = roots**3 @ to_linear.T
    curved = 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055
    return np.asarray(np.clip(np.where(linear <= 0.0031308, 12.92 * linear, curved), 0.0, 1.0))
