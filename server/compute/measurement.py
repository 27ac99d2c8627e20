"""One step of an analysis, in the worker: images by path, the result as a file in the analysis' folder.

What the steps of one analysis share (cameras, reference images and their spline coefficients, the grid of points, the
last two fields) is kept between tasks, and the next step's images are read while a step is fitted; a fresh worker makes
all of it again from the files, so a step measured anywhere gives the same result. To the last bit: fields of earlier
steps are taken from their files in any case, with the starts that lie beside them.
"""

from __future__ import annotations

import hashlib
import json
import time
import weakref
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from core.calibration.volume import CalibratedVolume
from core.cameras.camera import Camera
from core.cameras.stereo import StereoPair
from core.compiling import told_when_compiling
from core.errors import FileFormatError
from core.field.checks.extrapolated import mark_extrapolated
from core.field.points.images import MeasureImage, check_calibrated_size
from core.field.points.result import Field
from core.field.reference_update import ReferenceUpdate
from core.field.region.region import PointGrid
from core.field.seeding.seeds import Seed
from core.measure import Earlier, MeasureOptions, ReferencePair, Updating
from core.noise import NoiseModel
from core.threads import set_threads
from server.compute.compile_aside import CompileAside
from server.compute.region import make_grid
from server.compute.seeds import seeds_of
from server.compute.strain import smoothed_step, strain_of_step, strain_options, summarise_strain
from server.formats.calibrations.recognise import load_calibration
from server.formats.calibrations.volume import rbe_of, volume_of
from server.formats.files import sha256_of
from server.formats.images import GrayImage, read_image, read_mask
from server.formats.noise_json import load_noise
from server.formats.results.reading import read_measured
from server.formats.results.starts import read_starts, starts_file, write_starts
from server.formats.results.summary import summarise
from server.formats.results.writing import Provenance, write_field
from server.formats.version import software_version
from server.worker.process import current_task
from server.worker.tasks import StepTask

_KEPT = 2
_Pair = tuple[MeasureImage, MeasureImage]


@dataclass(eq=False)
class _Context:
    """What the steps of one analysis share."""

    reference: ReferencePair
    grid: PointGrid
    options: MeasureOptions
    volume: CalibratedVolume | None
    rbe_px: float | None
    frame: str
    fields: dict[int, Field] = field(default_factory=dict)
    sequence: Updating | None = None
    task: StepTask | None = None
    last: tuple[int, _Pair] | None = None
    ahead: tuple[tuple[str, str], Future[_Pair]] | None = None


_contexts: OrderedDict[str, _Context] = OrderedDict()
_reader = ThreadPoolExecutor(1, thread_name_prefix="stereorig-read")


def measure_step(task: StepTask) -> dict[str, Any]:
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
    began = time.perf_counter()
    context = _context_of(task)
    seeds = seeds_of(task.settings)
    more: dict[str, Any] = {"progress": channel.progress, "cancel": channel}
    if seeds is not None:
        more["seeds"] = seeds
    if task.kind == "shape":
        _read_ahead(task, context)
        result = context.reference.shape(context.grid, context.options, **more)
    else:
        shape = _field(task, context, task.reference)
        earlier = None
        if task.previous is not None and task.previous != task.reference:
            earlier = Earlier(task.previous, _field(task, context, task.previous))
        images = _images_now(task, context)
        _read_ahead(task, context)
        result = _sequence(context, task, shape).measure(images, earlier, **more)
        context.last = None if _update(task) == "never" else (task.n, images)
    computed = time.perf_counter()
    extra = {"label": task.label, "test_step": str(task.n)}
    if task.load_n is not None:
        extra["load_n"] = repr(task.load_n)
    inputs = dict(task.inputs)
    if result.references is not None:
        inputs["matched_cam1"], inputs["matched_cam2"] = task.earlier[result.references.step].sha256
    provenance = Provenance(
        settings=task.settings,
        inputs=inputs,
        software_version=software_version(),
        step=task.n,
        reference=task.reference,
        extra=extra,
        frame=context.frame,
    )
    shown = smoothed_step(result, task.settings.get("smoothing_window"), subset_px=task.settings["subset_px"])
    marked = mark_extrapolated(shown, context.volume)
    strain = strain_of_step(marked, strain_options(task.settings.get("strain")), subset_px=task.settings["subset_px"])
    path = _result_path(task, task.n)
    if result.starts is not None and task.keeps_starts:
        write_starts(starts_file(path), result.starts)  # first: where the result is, they are
    write_field(path, marked, provenance, strain, measured=result, checksum=True)
    if task.previous not in (None, task.reference):
        starts_file(_result_path(task, task.previous)).unlink(missing_ok=True)  # nobody starts from there any more
    # the next step needs the reference's field and this one, and reads this one as any other process would
    context.fields = {n: f for n, f in context.fields.items() if n == task.reference and n != task.n}
    summary = summarise(marked, rbe_px=context.rbe_px, reference=task.reference).document()
    summary["strain"] = None if strain is None else summarise_strain(strain).document()
    return {**summary, "compute_s": round(computed - began, 3), "write_s": round(time.perf_counter() - computed, 3)}


def _update(task: StepTask) -> ReferenceUpdate:
    # analyses of earlier versions have no such setting: theirs was total correlation
    mode: ReferenceUpdate = task.settings.get("reference_update", "never")
    return mode


def _sequence(context: _Context, task: StepTask, shape: Field) -> Updating:
    """What measures the analysis' steps; all that it needs of earlier ones it finds in memory or in the files."""
    context.task = task
    if context.sequence is None:
        own = weakref.proxy(context)  # no circle: what is dropped, images above all, is to go at once
        context.sequence = context.reference.sequence(
            shape,
            context.grid,
            context.options,
            reference_update=_update(task),
            first=task.reference,
            images_of=lambda n: _earlier_images(own, n),
            field_of=lambda n: _earlier_field(own, n),
        )
    return context.sequence


def _earlier_images(context: _Context, n: int) -> _Pair:
    """Images of an earlier step: those of the last one are still here, others are read and checked again."""
    if context.last is not None and context.last[0] == n:
        return context.last[1]
    assert context.task is not None
    step = context.task.earlier[n]
    for path, recorded in zip(step.images, step.sha256, strict=True):
        if sha256_of(Path(path)) != recorded:
            raise FileFormatError(
                f"{path} does not match the checksum in its step.json.",
                code="checksum_mismatch",
                remedy="Restore the file, or start the analysis again.",
            )
    return _read_pair(step.images, context.task, context.options)


def _earlier_field(context: _Context, n: int) -> Field:
    """Field of an earlier step as its file has it."""
    assert context.task is not None
    return mark_extrapolated(_field(context.task, context, n), context.volume)


def _images_now(task: StepTask, context: _Context) -> _Pair:
    """Return the step's images: those read while the step before was fitted, if they are these."""
    paths = task.images["cur1"], task.images["cur2"]
    ahead, context.ahead = context.ahead, None
    if ahead is not None and ahead[0] == paths:
        return ahead[1].result()
    return _read_pair(paths, task, context.options)


def _read_ahead(task: StepTask, context: _Context) -> None:
    """Begin to read the images of the step that will come next."""
    context.ahead = None
    if task.following is not None:
        context.ahead = task.following, _reader.submit(_read_pair, task.following, task, context.options)


def _read_pair(paths: tuple[str, str], task: StepTask, options: MeasureOptions) -> _Pair:
    models = _noise(task)
    one, two = (_seen(read_image(path), path, task, model) for path, model in zip(paths, models, strict=True))
    for image in (one, two):
        image.prepared(options.interpolation, None, options.blur)
        image.contrast()
    return one, two


def _noise(task: StepTask) -> tuple[NoiseModel | None, NoiseModel | None]:
    return (None, None) if task.noise is None else load_noise(task.noise).models


def _seen(image: GrayImage, path: str, task: StepTask, model: NoiseModel | None) -> MeasureImage:
    """An image with its camera's noise, which a mean of frames has less of."""
    return MeasureImage(image, path, noise=None if model is None else model.averaged(*task.averages[path]))


def _context_of(task: StepTask) -> _Context:
    key = hashlib.sha256(
        json.dumps([task.folder, task.calibration, task.images["ref1"], task.images["ref2"], task.settings]).encode()
    ).hexdigest()
    if key not in _contexts:
        _contexts[key] = _make_context(task)
        while len(_contexts) > _KEPT:
            _contexts.popitem(last=False)
    _contexts.move_to_end(key)
    return _contexts[key]


def _make_context(task: StepTask) -> _Context:
    settings = task.settings
    calibration = load_calibration(task.calibration)
    one, two = _image(task, "ref1"), _image(task, "ref2")
    check_calibrated_size("The image of cam1", one.shape, calibration.image_size1_px)
    check_calibrated_size("The image of cam2", two.shape, calibration.image_size2_px)
    options = MeasureOptions(
        subset_px=settings["subset_px"],
        patch=settings["patch"],
        interpolation=settings["interpolation"],
        prefilter_px=settings.get("prefilter_px", 0.0),
    )
    models = _noise(task)
    seen1, seen2 = (
        _seen(image, task.images[which], task, model)
        for image, which, model in zip((one, two), ("ref1", "ref2"), models, strict=True)
    )
    reference = ReferencePair(calibration.pair, seen1, seen2)
    return _Context(
        reference,
        _grid(task, one),
        options,
        volume_of(calibration),
        rbe_of(calibration),
        "target" if calibration.source == "calibration_json" else "camera1",
    )


def _grid(task: StepTask, image: GrayImage) -> PointGrid:
    mask_path = Path(task.folder) / "mask.png"
    mask = read_mask(mask_path) if mask_path.exists() else None
    return make_grid(task.settings, mask, (image.shape[0], image.shape[1]))


def _image(task: StepTask, which: str) -> GrayImage:
    return read_image(task.images[which])


def _result_path(task: StepTask, n: int) -> Path:
    return Path(task.folder) / f"step_{n:04d}.nc"


def _field(task: StepTask, context: _Context, n: int | None) -> Field:
    assert n is not None
    if n not in context.fields:
        path = _result_path(task, n)
        if not path.exists():
            raise FileFormatError(
                f"The result of step {n} is missing.", code="file_missing", remedy="Start the analysis again."
            )
        context.fields[n] = replace(read_measured(path), starts=read_starts(starts_file(path)))
    return context.fields[n]


def warm_up(threads: int) -> None:
    """Load the kernels of the default settings and run them once on a small pair of images."""
    set_threads(threads)
    # a plane seen by two cameras side by side: camera 2's image is camera 1's, shifted by 6 px
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
    grid = PointGrid.rectangle(40.0, 40.0, 88.0, 88.0, step_px=8.0)
    seeds = [Seed(xy_px=(64.0, 64.0), xy2_px=(58.0, 64.0))]
    # other patches and the other interpolation compile when first asked for; compiled kernels are kept on disk
    options = MeasureOptions(subset_px=21, patch="stretch")
    with CompileAside(options.patch) as aside, told_when_compiling(aside.start):
        reference = ReferencePair(pair, left, right)
        shape = reference.shape(grid, options, seeds=seeds)
        aside.wait()
        reference.motion(left.copy(), right.copy(), grid, options, shape=shape)
