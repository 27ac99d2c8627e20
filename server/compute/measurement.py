"""One step of an analysis, in the worker: images by path, the result as a file in the analysis' folder.

The parts that the steps of one analysis share (cameras, reference images and their spline coefficients, the grid of
points, the last fields) are kept between tasks, the next step's images are read while a step is fitted, and that step
is fitted while this one's file is written; a fresh worker makes them again from the files, so that a step gives the
same result in every worker, to the last bit.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.compiling import NotCompiledError, refuse_compiling, report_compiling
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.matching.prewarp import NodeLattice, project_nodes, warp_image
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.systematic.interpolation import SmoothSlopes, interpolation_term
from stereorig.core.threads import available_threads, set_threads
from stereorig.server.compute.background_compilation import BackgroundCompilation, KernelsAside
from stereorig.server.compute.grid_kernels import find_drawn_grid, grid_aside
from stereorig.server.compute.overlap import Measure, MeasureAhead, RequestedStep, timed
from stereorig.server.compute.sequence import Pair, SequenceMeasurement
from stereorig.server.compute.tasks import StepImages, StepTask
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import read_mask
from stereorig.server.formats.noise_json import load_noise
from stereorig.server.formats.results.starts import starts_file
from stereorig.server.worker.process import current_task

_KEPT = 2


@dataclass(eq=False)
class _Analysis:
    """A measurement between its tasks."""

    sequence: SequenceMeasurement
    ahead: tuple[StepImages, Future[Pair]] | None = None

    def current_images(self, step: StepImages) -> Pair | None:
        """Return the step's images if they were read while the step before was fitted."""
        ahead, self.ahead = self.ahead, None
        return ahead[1].result() if ahead is not None and ahead[0] == step else None


_kept: OrderedDict[str, _Analysis] = OrderedDict()
_shape_aside, _motion_aside = KernelsAside("shape"), KernelsAside("motion")
_reader = ThreadPoolExecutor(1, thread_name_prefix="stereorig-read")
_ahead = MeasureAhead()


def measure_step(task: StepTask) -> dict[str, object]:
    """Measure one step and write ``step_<nnnn>.nc``; returns its summary.

    Raises
    ------
    InputError
        Images, calibration or region that do not fit together.
    SeedError
        No start was found.
    Cancelled
        The service asked for it.
    """
    channel = current_task()
    measured = _ahead.take(
        RequestedStep(_key_of(task), task.step, task.previous, task.from_head, task.against), channel
    )
    kept = _analysis_of(task)
    sequence = kept.sequence
    sequence.forget_replaced(task.generation)
    sequence.steps |= task.earlier
    if measured is None:
        measured = timed(_measuring(kept, task, task.step, task.previous), channel.progress, channel)
        if task.against is not None:
            sequence.keep_head(task.step, measured.field)
            return {"n": task.step.n, "compute_s": measured.seconds}
    elif task.following is not None:
        kept.ahead = task.following, _reader.submit(sequence.read, task.following)
    if task.following is not None and channel.keeps_going and _motion_aside.ended:
        after = RequestedStep(_key_of(task), task.following, task.step.n)
        _ahead.begin(after, _measuring(kept, task, task.following, task.step.n))
    agrees = {}
    if task.compared is not None:
        agrees["agrees"] = sequence.agrees(task.step, measured.field, task.compared)
    try:
        finished = sequence.finish(
            task.step, measured.field, about=task.about, in_service=True, keep_starts=task.keeps_starts
        )
    except BaseException:
        _ahead.drop()
        raise
    if task.previous not in (None, task.reference.n) and not task.from_head:
        # no later step starts from there
        starts_file(sequence.file_of(task.previous)).unlink(missing_ok=True)
    return {**finished.summary, **agrees, "compute_s": measured.seconds}


def _measuring(kept: _Analysis, task: StepTask, step: StepImages, previous: int | None) -> Measure:
    """Return the function that measures a step; the following step's images are read at the same time."""

    def measure(progress: Progress, cancel: CancelToken) -> Field:
        sequence = kept.sequence
        images = None if step.n == task.reference.n else kept.current_images(step) or sequence.read(step)
        if task.following is not None and step != task.following:
            kept.ahead = task.following, _reader.submit(sequence.read, task.following)
        alone: dict[str, Any] = {} if step != task.step else {"from_head": task.from_head, "against": task.against}
        return sequence.measure(step, images, previous=previous, progress=progress, cancel=cancel, **alone)

    return measure


def _key_of(task: StepTask) -> str:
    return repr((task.folder, task.calibration, task.reference, task.settings))


def _analysis_of(task: StepTask) -> _Analysis:
    key = _key_of(task)
    if key not in _kept:
        _kept[key] = _Analysis(_begin(task))
        while len(_kept) > _KEPT:
            _kept.popitem(last=False)
    _kept.move_to_end(key)
    return _kept[key]


def _begin(task: StepTask) -> SequenceMeasurement:
    mask_path = task.folder / "mask.png"
    mask = read_mask(mask_path) if mask_path.exists() else None
    return SequenceMeasurement(
        calibration=load_calibration(task.calibration),
        settings=task.settings,
        mask=mask,
        reference=task.reference,
        folder=task.folder,
        noise=None if task.noise is None else load_noise(task.noise),
    )


def warm_up(threads: int) -> None:
    """Load the default settings' kernels; missing ones are compiled in other processes, see :func:`await_kernels`."""
    set_threads(threads)
    if available_threads() < 2:  # a single processor has no time to spare
        compile_here(threads)
        return
    for asides, run in (((grid_aside,), find_drawn_grid), ((_shape_aside, _motion_aside), measure_small_steps)):
        try:
            with refuse_compiling():
                run()
        except NotCompiledError:
            for aside in asides:
                aside.start()


def await_kernels(*, motion: bool = True) -> None:
    """Return once :func:`warm_up` has a shape's kernels compiled; with ``motion`` also a displacement's.

    Raises
    ------
    Cancelled
        The service asked for it.
    """
    _shape_aside.wait(current_task())
    if motion:
        _motion_aside.wait(current_task())


def compile_here(threads: int) -> None:
    """Load the kernels of the default settings, or compile them: a displacement's in another process."""
    set_threads(threads)
    with BackgroundCompilation("affine") as compilation, report_compiling(compilation.start):
        measure_small_steps(compilation.wait)


def measure_small_steps(before_motion: Callable[[], None] = lambda: None, *, motion: bool = True) -> None:
    """Measure the shape in a small pair of images, and with ``motion`` a displacement of zero."""
    # a plane imaged by two cameras side by side: camera 2's image is camera 1's, shifted by 6 px
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.normal(size=(128, 150)), (0, 0), 1.3)
    texture = np.clip(128.0 + 45.0 * noise / noise.std(), 0, 255).astype(np.uint8)
    left, right = texture[:, 6:134].copy(), texture[:, 12:140].copy()
    common = {
        "phd_px": 1000.0,
        "cx_px": 64.0,
        "cy_px": 64.0,
        "kappa_per_px2": 0.0,
        "aspect": 1.0,
        "alpha_rad": 0.0,
        "beta_rad": 0.0,
        "gamma_rad": 0.0,
        "y0_mm": 0.0,
        "z0_mm": 100.0,
    }
    pair = StereoPair(Camera.from_paper(**common, x0_mm=0.0), Camera.from_paper(**common, x0_mm=-0.6))
    grid = PointGrid.rectangle(40.0, 40.0, 88.0, 88.0, spacing_px=8.0)
    seeds = [Seed(xy_px=(64.0, 64.0), xy2_px=(58.0, 64.0))]
    # other patches and the other interpolation compile when first asked for; compiled kernels are kept on disk
    options = MeasureOptions(subset_px=21, patch="affine")
    reference = ReferencePair(pair, left, right)
    shape = reference.shape(grid, options, seeds=seeds)
    one, two = (image.prepared(options.interpolation) for image in (reference.image1, reference.image2))
    interpolation_term(shape, pair, SmoothSlopes.of(one), [two], subset_px=options.subset_px)
    if motion:
        before_motion()
        reference.motion(left.copy(), right.copy(), grid, options, shape=shape)
        # a step of this few points does not need them, steps of a sequence do
        lattice, state = NodeLattice(40.0, 40.0, 8.0, 0), np.full((2, 2, 5, 4), 0.01)
        nodes, _ = project_nodes(pair, np.zeros((2, 2, 2)), state, lattice)
        warp_image(one, one.shape, lattice, np.nan_to_num(nodes[:, :, 2:4]), np.ones((1, 1), bool))
