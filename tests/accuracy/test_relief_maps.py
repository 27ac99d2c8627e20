"""Pictures of a field beside the truth on the accuracy pages."""

from __future__ import annotations

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np

from tests.bench.accuracy.reliefs import drawn
from tests.support.relief_truth import Found


def test_the_shape_is_drawn_from_its_deepest_valley_to_its_highest_point() -> None:
    height = np.array([[-6.0, -1.0], [0.0, 4.0]])
    xyz = np.stack([np.zeros((2, 2)), np.zeros((2, 2)), -height], axis=-1)
    everywhere = np.ones((2, 2), bool)
    found = Found(everywhere, np.zeros((2, 2), int), np.zeros((2, 2), np.int8), everywhere, np.ones((2, 2)))
    figure = drawn(SimpleNamespace(valid=everywhere, xyz_mm=xyz), found)
    panel = next(ax for ax in figure.axes if ax.get_title() == "height, mm")
    assert panel.images[0].get_clim() == (-6.0, 4.0)
    plt.close(figure)
