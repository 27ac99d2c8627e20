"""Steps as figures: one variable as a colour map, with units and provenance."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.field.region.cuts import Cuts
from server.base.errors import NotFoundError
from server.formats.figures.axes import directions_of, scale_of_image
from server.formats.figures.figure import Picture, PictureForm, draw
from server.formats.figures.options import FigureStyle
from server.formats.files import write_bytes
from server.formats.images import read_image
from server.results.provenance import notes_of, provenance
from server.results.steps import Source, StepResult, columns_of

_STRAIN = re.compile(r"(sigma_|expanded_)?(exx|eyy|exy|e1|e2|max_shear|von_mises)(_patch)?")


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
    places = [columns[at].values for at in ("x_px", "y_px", "x_mm", "y_mm")]
    return Picture(
        axes=directions_of(*places),
        px_per_mm=scale_of_image(*places),
        strain=_STRAIN.fullmatch(name) is not None,
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
