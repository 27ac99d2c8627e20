"""Speed of the dense part of a step: a pair of a megapixel, a vector every 2 px, the shape known.

    python -m tests.bench.dense.speed

Timed are the prediction, the windows and their checks, from an ordinary displacement and prepared images to the dense
field in memory. Processor time of one thread is the figure to compare on a busy machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from stereorig.core.dense.field import dense_motion, dense_shape
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.settings import INTERPOLATIONS, Interpolation
from stereorig.core.threads import available_threads, set_threads
from tests.bench.accuracy.table import Row
from tests.bench.speed.layout import table, thousands
from tests.bench.speed.scene import capture, rig_of_size

SIZE_PX = (1024, 1024)
STEP_PX = 2
MARGIN_PX = 20
ASKED = 1e6


@dataclass(frozen=True)
class DenseRate:
    """Speed with one interpolation on some threads, least time of several runs.

    Attributes
    ----------
    vectors
        Valid ones.
    wall_s, cpu_s
        Of one step; ``cpu_s`` of the whole process.
    """

    interpolation: Interpolation
    threads: int
    vectors: int
    wall_s: float
    cpu_s: float

    @property
    def rate(self) -> float:
        """Vectors a second by the wall."""
        return self.vectors / self.wall_s


def measure_dense(runs: int = 5) -> list[DenseRate]:
    """Measure the dense displacement of one pair with each interpolation, at one thread and at two."""
    rig = rig_of_size(SIZE_PX)
    pictures = [*capture(rig, 0), *capture(rig, 1)]
    last = SIZE_PX[0] - 1 - MARGIN_PX, SIZE_PX[1] - 1 - MARGIN_PX
    grid = PointGrid.rectangle(MARGIN_PX, MARGIN_PX, *last, spacing_px=10)
    found = []
    for kind in INTERPOLATIONS:
        options = MeasureOptions(patch="affine", interpolation=kind)
        images = [MeasureImage(picture) for picture in pictures]
        reference = ReferencePair(rig.pair, images[0], images[1])
        shape = reference.shape(grid, options)
        motion = reference.motion(images[2], images[3], grid, options, shape=shape)
        dense = dense_shape(rig.pair, images[:2], shape, grid, options, step_px=STEP_PX)
        for threads in sorted({1, min(2, available_threads())}):
            set_threads(threads)
            times = []
            for _ in range(runs + 1):
                wall, cpu = time.perf_counter(), time.process_time()
                step = dense_motion(rig.pair, images, shape, motion, dense, grid, options, step_px=STEP_PX)
                times.append((time.perf_counter() - wall, time.process_time() - cpu))
            least = np.min(times[1:], axis=0)  # kernels are compiled in the first
            found.append(DenseRate(kind, threads, int(step.valid.sum()), float(least[0]), float(least[1])))
    set_threads(available_threads())
    return found


def rows(rates: list[DenseRate]) -> list[Row]:
    """Figures with their target."""
    most = max(rate.threads for rate in rates)
    return [
        Row(
            f"dense displacement, a vector every {STEP_PX} px, {r.interpolation}, {r.threads} thread(s)",
            r.rate,
            "vectors/s",
            ASKED if r.threads == most > 1 and r.interpolation == "cubic" else None,
            at_least=True,
        )
        for r in rates
    ]


def text(rates: list[DenseRate]) -> str:
    """The section of the page on performance."""
    lines = [
        [r.interpolation, str(r.threads), thousands(r.vectors), thousands(r.rate), f"{1e6 * r.cpu_s / r.vectors:.2f}"]
        for r in rates
    ]
    head = ["spline", "threads", "vectors", "vectors/s", "processor time, us a vector"]
    return (
        f"A pair of {SIZE_PX[0]} x {SIZE_PX[1]} px, 33 px windows, the ordinary displacement and the dense shape known: "
        "prediction, windows, checks and covariances of one step, in memory. Windows of neighbours overlap: these are "
        "not independent points.\n\n" + table(head, lines)
    )


if __name__ == "__main__":
    print(text(measure_dense()))
