"""Parts in relief: what is found of every face, and how far the worst valid point lies from the truth.

Pictures by a renderer that shares nothing with the program. Points asked for are those whose subset both cameras see,
whole, on one smooth face.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, measure_shape
from tests.bench.accuracy.kept import kept
from tests.bench.accuracy.table import Row, Section
from tests.support.relief_parts import relief_plate
from tests.support.relief_rig import CYLINDER, PLATEAU, RIDGE, VALLEY, Body, Feature, two_cameras
from tests.support.relief_truth import Found, Measured, Part

SIZE = (640, 512)
SUBSETS_PX = (21, 27, 33)
PLACEMENTS = 20
SPACING_PX = 5.0
_REGION_PX = (520.0, 400.0)

Images = tuple[NDArray[np.uint8], NDArray[np.uint8]]


def wedges() -> Body:
    """A plate with wedges of 45 and 55 degrees, one of them lying, plateaus of 4 and 8 mm and a valley."""
    slope = float(np.deg2rad(45.0))
    return Body(
        (
            Feature(RIDGE, (-18.0, -10.0), (5.0, 9.0), 5.0, slope),
            Feature(RIDGE, (0.0, -13.0), (9.0, 5.0), 5.0, slope, turn=float(np.pi / 2)),
            Feature(PLATEAU, (-16.0, 12.0), (7.0, 6.0), 4.0),
            Feature(PLATEAU, (17.0, -12.0), (6.0, 6.0), 8.0),
            Feature(VALLEY, (2.0, 10.0), (6.0, 8.0), 6.0, slope),
            Feature(RIDGE, (18.0, 11.0), (4.0, 8.0), 5.7, float(np.deg2rad(55.0))),
        )
    )


def cylinder() -> Body:
    """A cylinder of 25 mm radius, to 45 degrees, on a plate."""
    return Body((Feature(CYLINDER, (0.0, 0.0), (25.0, 25.0), 25.0, float(np.deg2rad(45.0))),))


def jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """What is left of an image after JPEG."""
    code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def placements(seed: int, number: int = PLACEMENTS) -> list[PointGrid]:
    """Regions of one size, their corners drawn at random."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(28, 80, (number, 2)).astype(float)
    return [PointGrid.rectangle(x, y, x + _REGION_PX[0], y + _REGION_PX[1], spacing_px=SPACING_PX) for x, y in corners]


def _measured(part: Part, images: Images, grid: PointGrid, subset_px: int) -> tuple[Field, Found]:
    field = measure_shape(part.pair, *images, grid, MeasureOptions(subset_px=subset_px))
    return field, part.beside_truth(field, grid, subset_px)


class Share(NamedTuple):
    """What was found of the points on one face, what no start led to, faces left empty, worst error over its sigma."""

    found: float
    unreached: float
    empty_faces: float
    worst_sigmas: float


def _shares(name: str, part: Part, images: Images, grids: list[PointGrid], subset_px: int) -> list[Share]:
    def share(grid: PointGrid) -> dict[str, float]:
        found = _measured(part, images, grid, subset_px)[1]
        return Share(found.share, found.unreached, float(len(found.empty_faces)), found.worst)._asdict()

    return [
        Share(**kept("faces", f"{name}, {subset_px} px, placement {k}", partial(share, grid)))
        for k, grid in enumerate(grids)
    ]


def _rows(name: str, found: list[Share], asked_percent: float) -> list[Row]:
    return [
        Row(
            f"{name}: found of the points on one face, least",
            100.0 * min(f.found for f in found),
            "%",
            asked_percent,
            at_least=True,
        ),
        Row(f"{name}: never reached, most", 100.0 * max(f.unreached for f in found), "%", 1.0),
        Row(f"{name}: faces left empty, of all placements", sum(f.empty_faces for f in found), "", 0.0),
        Row(f"{name}: worst error of a valid point over its sigma", max(f.worst_sigmas for f in found), "", 5.0),
    ]


def plate(figures: Path) -> Section:
    """A plate with wedges, without seeds, in random placements of the region."""
    return _plate(
        wedges(),
        figures / "accuracy_faces_plate.png",
        "Plate with wedges",
        "Faces of 45 and 55 degrees, plateaus of 4 and 8 mm, a valley",
    )


def ball(figures: Path) -> Section:
    """A plate with a ball and a cylinder too."""
    return _plate(
        relief_plate(),
        figures / "accuracy_faces_ball.png",
        "Plate with ball and cylinder",
        "A ridge and a valley of 45 degrees, a step of 4 mm, a ball and a cylinder to 60 degrees",
    )


def _plate(body: Body, figure: Path, title: str, what: str) -> Section:
    part = Part(two_cameras(SIZE), (body,))
    images = part.images()
    rows: list[Row] = []
    for subset in SUBSETS_PX:
        shares = _shares(title, part, images, placements(subset), subset)
        rows += _rows(f"{subset} px, {PLACEMENTS} placements", shares, 99.0)
    first = SUBSETS_PX[0]
    maps(figure, *_measured(part, images, placements(first)[0], first))
    return Section(
        title,
        f"{what}; 640 x 512 px, noise 2, views 23 degrees apart; default options, no seed, the region's corner drawn at random.",
        rows,
        [(figure.name, "Status, error over reported sigma, and shape of one field, 21 px")],
        [],
    )


def misfit(figures: Path) -> Section:
    """A lens that is smoothly off by 0.15 px in the corners."""
    part = Part(two_cameras(SIZE, misfit_px=(0.0, 0.15)), (Body(),))
    grid = PointGrid.rectangle(28.0, 28.0, 612.0, 484.0, spacing_px=SPACING_PX)
    field, found = _measured(part, part.images(), grid, 33)
    maps(figures / "accuracy_faces_misfit.png", field, found)
    rows = [Row("33 px: found of the points on one face", 100.0 * found.share, "%", 99.9, at_least=True)]
    return Section(
        "A lens smoothly off in its corners",
        "A flat plate; camera 2 is off by 0.15 px in its corners, with the fifth power of the distance, and the calibration does not know.",
        rows,
        [("accuracy_faces_misfit.png", "Status, error over reported sigma, and shape")],
        ["The error over sigma is that of the lens, which no point's sigma holds."],
    )


def rough(figures: Path) -> Section:
    """A cylinder in noisy JPEG images."""
    part = Part(two_cameras(SIZE), (cylinder(),))
    first, second = (jpeg(image, 75) for image in part.images(noise=8.0))
    grids = placements(41, 3)
    shares = _shares("Cylinder", part, (first, second), grids, 41)
    maps(figures / "accuracy_faces_cylinder.png", *_measured(part, (first, second), grids[0], 41))
    return Section(
        "Cylinder in noisy JPEG images",
        "Radius 25 mm, to 45 degrees; noise 8, JPEG of quality 75.",
        _rows("41 px, 3 placements", shares, 99.0),
        [("accuracy_faces_cylinder.png", "Status, error over reported sigma, and shape of one field")],
        [],
    )


def maps(path: Path, field: Measured, found: Found) -> None:
    """Draw status, error over sigma, and shape into a file."""
    fig = drawn(field, found)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def drawn(field: Measured, found: Found) -> Figure:
    """Return a figure of status, error over sigma, and shape with its valleys."""
    fig, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    draw_row(fig, axes, field, found)
    return fig


def draw_row(
    fig: Figure, axes: Sequence[Axes], field: Measured, found: Found, most_sigmas: float | None = None
) -> None:
    """Draw status, error over sigma up to ``most_sigmas`` (None: the largest), and shape into three axes."""
    kinds = np.where(field.valid, 0, np.where(found.on_one_face, 2, 1))
    shown = axes[0].imshow(kinds, cmap=plt.get_cmap("viridis", 3), vmin=-0.5, vmax=2.5)
    bar = fig.colorbar(shown, ax=axes[0], ticks=[0, 1, 2])
    bar.ax.set_yticklabels(["valid", "on an edge or hidden", "lost"])
    for ax, values, limits, name in (
        (axes[1], found.error_sigmas, (0.0, most_sigmas), "error over sigma"),
        (axes[2], -field.xyz_mm[..., 2], (None, None), "height, mm"),
    ):
        fig.colorbar(ax.imshow(values, vmin=limits[0], vmax=limits[1]), ax=ax)
        ax.set_title(name)
    axes[0].set_title("status")
    for ax in axes:
        ax.set_axis_off()


SECTIONS = {"faces-plate": plate, "faces-ball": ball, "faces-misfit": misfit, "faces-cylinder": rough}
