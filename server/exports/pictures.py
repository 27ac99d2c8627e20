"""Steps as figures: one variable as a colour map, with units and provenance."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.region.cuts import Cuts
from stereorig.server.base.errors import NotFoundError, no_variable
from stereorig.server.formats.figures.axes import directions_of, scale_of_image
from stereorig.server.formats.figures.figure import FigureData, PictureForm, draw
from stereorig.server.formats.figures.options import FigureStyle
from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.images import read_image
from stereorig.server.formats.results.variables import described
from stereorig.server.results.provenance import notes_of, provenance
from stereorig.server.results.steps import ExportSource, StepResult, columns_of


def picture_of(
    step: StepResult, name: str, source: ExportSource, image: NDArray[np.generic] | None = None
) -> FigureData:
    """Return a variable of a step as a picture.

    Parameters
    ----------
    name
        Name of a variable with one number a point, such as ``zncc_<comparison>``.
    image
        Camera 1's reference image to draw over.

    Raises
    ------
    NotFoundError
        ``field_missing``.
    """
    columns = columns_of(step)
    if name not in columns:
        raise no_variable(f"Step {step.n}", name, columns)
    variable, document = columns[name], provenance(step, source)
    load = "" if step.load_n is None else f", load {step.load_n:g} N"
    label = f" ({step.label})" if step.label else ""
    cuts: Cuts | None = step.cuts
    places = [columns[at].values for at in ("x_px", "y_px", "x_mm", "y_mm")]
    return FigureData(
        axes=directions_of(*places),
        px_per_mm=scale_of_image(*places),
        strain=described(name).kind == "strain",
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


def image_of(source: ExportSource, over_image: bool) -> NDArray[np.generic] | None:
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


def write_figure(path: Path, picture: FigureData, style: FigureStyle, form: PictureForm) -> None:
    """Write one figure."""
    write_bytes(path, draw(picture, style, form))
