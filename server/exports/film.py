"""Films: a frame a step, all on one scale, as GIF or MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from stereorig.core.errors import InputError, StorageError
from stereorig.server.exports.pictures import picture_of
from stereorig.server.formats.figures.axes import COLOURS
from stereorig.server.formats.figures.colours import colour_map
from stereorig.server.formats.figures.figure import FigureData, Frames, Scale, scale_of
from stereorig.server.formats.figures.options import FigureStyle
from stereorig.server.formats.files import written_temporary
from stereorig.server.results.steps import ExportSource, columns_of, each
from stereorig.server.worker.process import current_task

FPS_RANGE = (0.1, 60.0)
# VP9, which browsers play; MPEG-4 part 2, which they do not, only where OpenCV was built without libvpx
CODECS = ("vp09", "mp4v")
_MAX_SAMPLES = 20_000  # of a step, for the percentiles of a film
_COLOURS = 255  # of a GIF; the 256th is transparent
_OF_THE_BAR = 96


@dataclass(frozen=True)
class _Survey:
    """Common data of the frames of a film."""

    numbers: list[int]  # of the steps that have the variable
    scale: Scale | None
    first: FigureData  # with the longest title and notes


def frames(
    source: ExportSource, steps: Sequence[int] | None, name: str, style: FigureStyle, image: NDArray[np.generic] | None
) -> Iterator[NDArray[np.uint8]]:
    """Draw the steps that have the variable, one after the other, on one colour scale.

    Raises
    ------
    NotFoundError
        ``field_missing`` if none has it.
    InputError
        ``steps_mixed`` if their points differ.
    Cancelled
        The task that draws them is to stop.
    """
    task = current_task()
    survey = _survey(source, steps, name, style, image)
    made = Frames(survey.first, style, survey.scale)
    for k, step in enumerate(each(source, survey.numbers, [name])):
        task.check()
        task.progress("drawing", k, len(survey.numbers))
        yield made.next(picture_of(step, name, source, image))
    task.progress("writing", len(survey.numbers), len(survey.numbers))


def _survey(
    source: ExportSource, steps: Sequence[int] | None, name: str, style: FigureStyle, image: NDArray[np.generic] | None
) -> _Survey:
    task = current_task()
    samples, ends, numbers = [], [], []
    title, notes, first, last = "", [""], None, None
    for step in each(source, steps, [name]):
        task.check()
        last = step
        variable = columns_of(step).get(name)
        if variable is None:
            continue  # a reference has no displacement
        numbers.append(step.n)
        picture = picture_of(step, name, source, image)
        first = first or picture
        _check_same_points(first, picture)
        title = max(title, picture.title, key=len)
        notes = max(notes, list(picture.notes), key=lambda lines: len("".join(lines)))
        if variable.flags is None and (finite := variable.values[np.isfinite(variable.values)]).size:
            samples.append(finite[:: max(1, finite.size // _MAX_SAMPLES)])
            ends.append((finite.min(), finite.max()))
    if first is None:
        assert last is not None, "a source has a step"
        first = picture_of(last, name, source)  # the error names those that there are
    limits = scale_of(np.concatenate(samples), style) if samples else style.limits
    scale = None
    if limits is not None:
        lowest, highest = (min(low for low, _ in ends), max(high for _, high in ends)) if ends else limits
        scale = Scale(*limits, bool(lowest < limits[0]), bool(highest > limits[1]))
    return _Survey(numbers, scale, replace(first, title=title, notes=notes))


def _check_same_points(first: FigureData, picture: FigureData) -> None:
    if first.values.shape != picture.values.shape or not (
        np.array_equal(first.x_px, picture.x_px) and np.array_equal(first.y_px, picture.y_px)
    ):
        raise InputError(
            "The steps' fields have different outlines.",
            code="steps_mixed",
            remedy="Make a film of the steps of one analysis.",
        )


def write_gif(
    path: Path, drawn: Iterator[NDArray[np.uint8]], fps: float, comment: str, style: FigureStyle, *, over_image: bool
) -> None:
    """Write an animated GIF that repeats; frames are shown for 1/``fps`` s, to a hundredth of a second."""
    check_fps(fps)
    first = next(drawn)
    palette = _palette(first, style, style.opacity if over_image else 1.0)

    def reduced(pixels: NDArray[np.uint8]) -> Image.Image:
        return _with_palette(pixels, palette)

    with written_temporary(path) as temporary:
        reduced(first).save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=(reduced(pixels) for pixels in drawn),
            duration=max(20, round(1000.0 / fps)),
            loop=0,
            comment=comment.encode("ascii", "backslashreplace"),
            disposal=1,
        )


def _palette(pixels: NDArray[np.uint8], style: FigureStyle, opacity: float) -> NDArray[np.uint8]:
    """Return (n, 3) a palette for all frames: the colours of bar and axes, which few pixels have, and the picture's."""
    levels = np.linspace(0.0, 1.0, _OF_THE_BAR)
    map_ = colour_map(style.colours, style.levels, reverse=style.reverse)(levels)[:, :3]
    rare = np.concatenate([opacity * map_ + 1.0 - opacity, [to_rgb(one) for one in COLOURS.values()]])
    bar = np.unique(np.rint(255.0 * rare).astype(np.uint8), axis=0)
    own = Image.fromarray(pixels).quantize(_COLOURS - len(bar), method=Image.Quantize.MEDIANCUT)
    return np.concatenate([bar, np.array(own.getpalette(), dtype=np.uint8).reshape(-1, 3)])[:_COLOURS]


def _with_palette(pixels: NDArray[np.uint8], palette: NDArray[np.uint8]) -> Image.Image:
    """Return a picture with the nearest colours of a palette; Pillow's own search is coarser than a smooth bar."""
    packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    colours, where = np.unique(packed, return_inverse=True)
    apart = np.stack([colours >> 16, colours >> 8 & 255, colours & 255], axis=-1)
    nearest: NDArray[np.uint8] = np.asarray(cKDTree(palette).query(apart)[1], dtype=np.uint8)
    made = Image.fromarray(nearest[where].reshape(pixels.shape[:2]), mode="P")
    made.putpalette(palette.ravel().tolist())
    return made


def write_mp4(path: Path, drawn: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write a film: VP9 in an MP4 container, through OpenCV.

    Raises
    ------
    StorageError
        ``storage_failed`` if the film cannot be opened for writing or has no content.
    """
    check_fps(fps)
    first = next(drawn)
    height, width = first.shape[:2]
    with written_temporary(path) as temporary:
        named = temporary.with_suffix(".mp4")  # the name determines the container
        writer = cv2.VideoWriter()
        try:
            for codec in CODECS:
                if writer.open(str(named), cv2.VideoWriter.fourcc(*codec), fps, (width, height)):
                    break
            if not writer.isOpened():
                raise StorageError(
                    f"No film can be written to {path}: OpenCV does not open it.",
                    remedy="Check the folder; choose gif if this OpenCV writes no MP4.",
                )
            write = _writer_of(writer)
            write(first)
            for pixels in drawn:
                write(pixels)
            writer.release()
            named.rename(temporary)
        finally:
            writer.release()
            named.unlink(missing_ok=True)


def _writer_of(writer: cv2.VideoWriter) -> Callable[[NDArray[np.uint8]], None]:
    def write(pixels: NDArray[np.uint8]) -> None:
        writer.write(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))

    return write


def check_fps(fps: float) -> None:
    """Raise an error for a frame rate that no player plays."""
    if not FPS_RANGE[0] <= fps <= FPS_RANGE[1]:
        raise InputError(
            f"{fps:g} frames a second is not between {FPS_RANGE[0]:g} and {FPS_RANGE[1]:g}.",
            code="figure_style_invalid",
            remedy="Give another rate.",
        )
