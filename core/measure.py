"""Shape and displacement of a full field: from images to a checked result.

Entry points of the measurement; their phases are in ``stereorig.core.field``, the point-level matching in
``stereorig.core.matching``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.field.growth.field import motion_field, shape_field
from stereorig.core.field.growth.seed import Seeds
from stereorig.core.field.growth.state import Image, prepare
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.reference_steps import PreviousStep, Updating
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.settings import DEFAULT_REFERENCE_UPDATE, ReferenceUpdate

__all__ = ["MeasureOptions", "PreviousStep", "ReferencePair", "Updating", "measure_motion", "measure_shape"]


@dataclass(frozen=True, eq=False)
class ReferencePair:
    """The reference images of a sequence: prepared once, used in every step.

    >>> reference = ReferencePair(pair, image1, image2)            # doctest: +SKIP
    >>> shape = reference.shape(grid, options)                     # doctest: +SKIP
    >>> step = reference.motion(now1, now2, grid, options, shape=shape)  # doctest: +SKIP
    """

    pair: StereoPair
    image1: MeasureImage
    image2: MeasureImage

    def __init__(self, pair: StereoPair, image1: Image, image2: Image) -> None:
        pair.require_baseline()
        object.__setattr__(self, "pair", pair)
        object.__setattr__(self, "image1", MeasureImage(image1, "camera 1's reference image"))
        object.__setattr__(self, "image2", MeasureImage(image2, "camera 2's reference image"))

    def shape(self, grid: PointGrid, options: MeasureOptions | None = None, **more: Any) -> Field:
        """Measure the reference's shape; see :func:`measure_shape`."""
        return measure_shape(self.pair, self.image1, self.image2, grid, options, **more)

    def motion(
        self, image1: Image, image2: Image, grid: PointGrid, options: MeasureOptions | None = None, **more: Any
    ) -> Field:
        """Measure the displacement to a later pair; see :func:`measure_motion`."""
        return measure_motion(self.pair, self.image1, self.image2, image1, image2, grid, options, **more)

    def sequence(
        self,
        shape: Field,
        grid: PointGrid,
        options: MeasureOptions | None = None,
        *,
        reference_update: ReferenceUpdate = DEFAULT_REFERENCE_UPDATE,
        images_of: Callable[[int], tuple[MeasureImage, MeasureImage]],
        field_of: Callable[[int], Field],
        first: int = 0,
    ) -> Updating:
        """Return a measurement of the steps of a sequence in order, with later references if they are needed.

        Parameters
        ----------
        shape, grid, options
            The reference's shape, as for :meth:`motion`.
        reference_update
            ``never``, ``auto`` or ``always``, see :mod:`stereorig.core.field.sequence.reference_steps`.
        images_of, field_of
            Images and field of an earlier step, by its number.
        first
            Number of the reference.
        """
        return Updating(
            self.pair,
            (self.image1, self.image2),
            shape,
            grid,
            options or MeasureOptions(),
            mode=reference_update,
            images_of=images_of,
            field_of=field_of,
            first=first,
        )


def measure_shape(
    pair: StereoPair,
    image1: Image,
    image2: Image,
    grid: PointGrid,
    options: MeasureOptions | None = None,
    *,
    seeds: Seeds | None = None,
    progress: Progress | None = None,
    cancel: CancelToken | None = None,
) -> Field:
    """Measure the shape of the surface, section 4.1.

    Parameters
    ----------
    pair
        The calibrated cameras.
    image1, image2
        (rows, cols) camera 1's and camera 2's image, raw or prepared.
    grid
        Points in camera 1's image.
    options
        Defaults to ``MeasureOptions()``.
    seeds
        Seed points, (x, y) in camera 1 or ``Seed``; found from feature matches when left out.
    progress, cancel
        Receiver of reports (phase, points done, points in all), and the means to stop.

    Returns
    -------
    Field
        Lengths in mm, system frame. Points that failed a check have a status and no numbers.

    Raises
    ------
    RegionError, ImageError
        If region or images cannot be used; ``cameras_swapped`` if they fit with exchanged roles only.
    InputError
        ``baseline_zero`` if both cameras have the same position.
    SeedError
        If no start was found.
    Cancelled
        If the token is set.
    """
    inputs = prepare(pair, (image1, image2), None, grid, options, progress=progress, cancel=cancel)
    return shape_field(inputs, seeds)


def measure_motion(
    pair: StereoPair,
    ref1: Image,
    ref2: Image,
    cur1: Image,
    cur2: Image,
    grid: PointGrid,
    options: MeasureOptions | None = None,
    *,
    shape: Field | None = None,
    previous: Field | None = None,
    seeds: Seeds | None = None,
    progress: Progress | None = None,
    cancel: CancelToken | None = None,
) -> Field:
    """Measure the displacement since the reference, section 4.2: three comparisons at once.

    Parameters
    ----------
    pair
        The calibrated cameras.
    ref1, ref2, cur1, cur2
        (rows, cols) both cameras' reference and current images, raw or prepared.
    grid
        Points in camera 1's reference image.
    options
        Defaults to ``MeasureOptions()``.
    shape
        The reference's shape on the same grid; measured first when left out. Only its valid points are measured.
    previous
        An earlier step's field on the same grid, to start from.
    seeds, progress, cancel
        As in :func:`measure_shape`.

    Returns
    -------
    Field
        With ``uvw_mm``, ``rotation_rad`` and ``stretch``; ``xyz_mm`` is the shape's, the same in every step.

    Raises
    ------
    RegionError, ImageError, SeedError, Cancelled
        As in :func:`measure_shape`.
    InputError
        ``grid_mismatch`` if ``shape`` or ``previous`` belongs to another grid.
    """
    reference1, reference2 = (
        MeasureImage(ref1, "camera 1's reference image"),
        MeasureImage(ref2, "camera 2's reference image"),
    )
    if shape is None:
        shape = measure_shape(
            pair, reference1, reference2, grid, options, seeds=seeds, progress=progress, cancel=cancel
        )
    images = (reference1, reference2), (cur1, cur2)
    inputs = prepare(pair, *images, grid, options, progress=progress, cancel=cancel)
    for name, other in (("shape", shape), ("previous", previous)):
        if other is not None and (other.shape != grid.shape or not np.allclose(other.x_px, grid.x_px)):
            raise InputError(
                f"the {name} field has {other.shape} points, the grid {grid.shape}, or they lie elsewhere.",
                code="grid_mismatch",
                remedy="Measure every step on the same grid.",
            )
    return motion_field(inputs, shape, previous, seeds)
