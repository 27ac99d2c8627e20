"""Steps as figures and films: one variable as a colour map, with units and provenance."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from core.errors import InputError, StorageError
from core.field.region.cuts import Cuts
from server.base.errors import NotFoundError
from server.formats.figure import Picture, PictureForm, draw, draw_pixels, scale_of
from server.formats.figure_axes import directions_of
from server.formats.figure_options import FigureStyle
from server.formats.files import write_bytes, written_temporary
from server.formats.images import read_image
from server.results.provenance import notes_of, provenance
from server.results.steps import Source, StepResult, columns_of, each

FPS_RANGE = (0.1, 60.0)
# VP9, which browsers play; MPEG-4 part 2, which they do not, only where OpenCV was built without libvpx
CODECS = ("vp09", "mp4v")
_MAX_SAMPLES = 20_000  # of a step, for the percentiles of a film
_PALETTE = 255


def picture_of(step: StepResult, name: str, source: Source, image: NDArray[np.generic] | None = None) -> Picture:
    """Return a variable of a step as a picture.

    Parameters
    ----------
    name
        Of a variable with one number a point; ``zncc_<comparison>`` is one.
    image
        Camera 1's reference image to draw over.

    Raises
    ------
    NotFoundError
        ``field_missing``.
    """
    columns = columns_of(step)
    if name not in columns:
        raise NotFoundError(
            f"Step {step.n} has no variable {name!r} with one number a point.",
            code="field_missing",
            remedy="Use one of `available`.",
            available=sorted(columns),
        )
    variable, document = columns[name], provenance(step, source)
    load = "" if step.load_n is None else f", load {step.load_n:g} N"
    label = f" ({step.label})" if step.label else ""
    cuts: Cuts | None = step.cuts
    return Picture(
        axes=directions_of(*(columns[at].values for at in ("x_px", "y_px", "x_mm", "y_mm"))),
        values=variable.values,
        x_px=columns["x_px"].values,
        y_px=columns["y_px"].values,
        label=f"{name}: {variable.long_name}",
        units=variable.units,
        flags=variable.flags,
        title=f"{source.title or source.name}, step {step.n}{label}{load}",
        notes=notes_of(step, source),
        image=image,
        cuts=cuts,
        metadata={
            "Software": str(document["software"]),
            "Variable": name,
            "Units": variable.units,
            "Provenance": json.dumps(document, sort_keys=True),
        },
    )


def image_of(source: Source, over_image: bool) -> NDArray[np.generic] | None:
    """Return camera 1's reference image if it is to be drawn over.

    Raises
    ------
    NotFoundError
        ``image_missing`` if it is not known or gone.
    """
    if not over_image:
        return None
    if source.image is None or not source.image.is_file():
        where = "" if source.image is None else f" ({source.image})"
        raise NotFoundError(
            f"Camera 1's reference image is not there{where}.",
            code="image_missing",
            remedy="Draw the map alone, or give the image.",
        )
    return read_image(source.image)


def write_figure(path: Path, picture: Picture, style: FigureStyle, form: PictureForm) -> None:
    """Write one figure."""
    write_bytes(path, draw(picture, style, form))


def common_style(source: Source, steps: Sequence[int] | None, name: str, style: FigureStyle) -> FigureStyle:
    """Return the style with one colour scale for all steps; percentiles are those of all steps' values together."""
    if style.limits is not None:
        return style
    samples = []
    for step in each(source, steps, [name]):
        variable = columns_of(step).get(name)
        if variable is not None and variable.flags is None:
            finite = variable.values[np.isfinite(variable.values)]
            samples.append(finite[:: max(1, finite.size // _MAX_SAMPLES)])
    limits = scale_of(np.concatenate(samples), style) if samples else None
    return FigureStyle(limits, style.percentiles, style.colours, style.width_px, style.opacity)


def frames(
    source: Source, steps: Sequence[int] | None, name: str, style: FigureStyle, image: NDArray[np.generic] | None
) -> Iterator[NDArray[np.uint8]]:
    """Draw the steps that have the variable, one after the other, on one colour scale.

    Raises
    ------
    NotFoundError
        ``field_missing`` if none has it.
    """
    common = common_style(source, steps, name, style)
    size: tuple[int, int] | None = None
    last: StepResult | None = None
    for step in each(source, steps, [name]):
        last = step
        if name not in columns_of(step):
            continue  # a reference has no displacement
        pixels = draw_pixels(picture_of(step, name, source, image), common)
        if size is not None and pixels.shape[:2] != size:
            raise InputError(
                "The steps' fields have different outlines.",
                code="steps_mixed",
                remedy="Make a film of the steps of one analysis.",
            )
        size = (pixels.shape[0], pixels.shape[1])
        yield pixels
    if size is None and last is not None:
        picture_of(last, name, source)  # the error names those that there are


def write_gif(path: Path, drawn: Iterator[NDArray[np.uint8]], fps: float, comment: str) -> None:
    """Write an animated GIF that repeats; frames are shown for 1/``fps`` s, to a hundredth of a second."""
    check_fps(fps)
    first = next(drawn)

    def rest() -> Iterator[Image.Image]:
        for pixels in drawn:
            yield _reduced_colours(pixels)

    with written_temporary(path) as temporary:
        _reduced_colours(first).save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=rest(),
            duration=max(20, round(1000.0 / fps)),
            loop=0,
            comment=comment.encode("ascii", "backslashreplace"),
            disposal=1,
        )


def _reduced_colours(pixels: NDArray[np.uint8]) -> Image.Image:
    return Image.fromarray(pixels).quantize(_PALETTE, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def write_mp4(path: Path, drawn: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write a film: VP9 in an MP4 container, through OpenCV.

    Raises
    ------
    StorageError
        ``storage_failed`` if the film cannot be opened for writing or nothing came of it.
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
