"""Images of a measurement: checked, prepared and searched for features once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import ImageError
from stereorig.core.field.points.features import Box, Features, Picture, detect_all
from stereorig.core.field.region.textured import Peaks, repeats
from stereorig.core.matching.blur import Blur
from stereorig.core.matching.defects import find_defects
from stereorig.core.matching.image import ImageData, prepare
from stereorig.core.noise import NoiseModel
from stereorig.core.settings import Interpolation

_TILE = 48
_MIN_STRUCTURE = 0.2
_BAND_PX = 6.0
_MIN_SIDE_PX = 32
_BAND_PIXELS = 1_000_000


class MeasureImage:
    """One image and the quantities computed from it.

    Parameters
    ----------
    image
        (rows, cols) grey levels uint8, uint16 or float; or an image already prepared.
    name
        Its name in errors.
    noise
        The camera's noise in this very image, if no other model is given. If it knows the sensor's fixed pattern and
        defective pixels, an image given as grey levels is taken without them.

    Raises
    ------
    ImageError
        ``image_shape``, ``image_type``, ``image_not_finite``.
    """

    def __init__(
        self, image: ArrayLike | ImageData | MeasureImage, name: str = "image", *, noise: NoiseModel | None = None
    ) -> None:
        self.name = name
        self.noise = noise
        self._prepared: dict[tuple[Interpolation, NoiseModel | None, Blur | None], ImageData] = {}
        self._features: dict[tuple[Box, int], Features] = {}
        self._variance: list[tuple[int, Blur | None, Float, Float]] = []  # for at most one set of points
        self._contrast: dict[tuple[float, float, float, float] | None, tuple[float, float, float]] = {}
        self._peaks: Peaks = {}
        self.defects: NDArray[np.int64] | None = None
        if isinstance(image, MeasureImage):
            self.noise = image.noise if noise is None else noise
            self.pixels: NDArray[Any] = image.pixels
            self.defects = image.defects
            self._prepared, self._features, self._variance = image._prepared, image._features, image._variance
            self._contrast, self._peaks = image._contrast, image._peaks
        elif isinstance(image, ImageData):
            self.pixels = image.pixels if image.unblurred is None else np.ascontiguousarray(image.unblurred)
            self.defects = image.defects
            kind: Interpolation = "cubic" if image.order == 3 else "quintic"
            if image.blur is None:
                self.noise = image.noise  # an image prepared with a noise model keeps it if no other one is given
                self._prepared[kind, image.noise, None] = image
        else:
            self.pixels = _checked(np.asarray(image), name)
            sensor = None if noise is None else noise.sensor
            if sensor is not None:
                self.pixels = sensor.subtracted_from(self.pixels, name)
            found = find_defects(self.pixels, None if sensor is None else sensor.defects)
            if found is not None:
                self.defects, self.pixels = found

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.pixels.shape[0]), int(self.pixels.shape[1])

    def prepared(
        self, interpolation: Interpolation, noise: NoiseModel | None = None, blur: Blur | None = None
    ) -> ImageData:
        """Return the image, blurred if requested, with its spline coefficients and the camera's noise; cached."""
        noise = self.noise if noise is None else noise
        key = interpolation, noise, blur
        if key not in self._prepared:
            self._prepared[key] = prepare(self.pixels, interpolation, noise, blur, self.defects)
        return self._prepared[key]

    def subset_variance(self, xy_px: Float, subset_px: int, blurred: ImageData | None = None) -> Float:
        """Return the grey-level variance (n,) in the square of ``subset_px`` about the pixels nearest to points (n, 2).

        The result is kept for the last points given: in a sequence they are the same in every step.

        Parameters
        ----------
        xy_px, subset_px
            Points and width.
        blurred
            The image as it is compared; as it was taken, if left out.
        """
        image, blur = (self.pixels, None) if blurred is None else (blurred.raw, blurred.blur)
        for known_px, known_blur, known_xy, known in self._variance:
            if (known_px, known_blur) == (subset_px, blur) and np.array_equal(known_xy, xy_px):
                return known
        rows, cols = self.shape
        mean = float(image.mean())
        at = np.clip(np.rint(xy_px[:, ::-1]).astype(int), 0, np.array(self.shape) - 1)
        out = np.empty(len(at))
        half, size = subset_px // 2, (subset_px, subset_px)
        band = max(_BAND_PIXELS // cols, 1)
        for first in range(0, rows, band):  # in bands: as float64 a large image would take gigabytes
            here = np.flatnonzero((at[:, 0] >= first) & (at[:, 0] < first + band))
            if len(here) == 0:
                continue
            top = max(first - half, 0)
            pixels = image[top : first + band + half].astype(np.float64)
            pixels -= mean
            about = cv2.boxFilter(pixels, -1, size)
            square = cv2.boxFilter(pixels * pixels, -1, size)
            r, c = at[here, 0] - top, at[here, 1]
            out[here] = np.maximum(np.asarray(square)[r, c] - np.asarray(about)[r, c] ** 2, 0.0)
        self._variance[:] = [(subset_px, blur, np.array(xy_px), out)]
        return out

    def repeating(self, xy_px: Float, subset_px: int) -> Bool:
        """Return (n,) True where the texture repeats itself about points (n, 2); places looked at are kept."""
        return repeats(self.pixels, xy_px, subset_px=subset_px, known=self._peaks)

    def contrast(self, box: tuple[float, float, float, float] | None = None) -> tuple[float, float, float]:
        """Return smallest and largest grey level and largest correlation of neighbouring pixels, in a box.

        None: in the whole image. Computed on the first call; structure is zero if there is only one grey level.
        """
        if box not in self._contrast:
            pixels = self.pixels
            if box is not None:
                x0, y0, x1, y1 = (round(v) for v in box)
                pixels = pixels[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1]
            low, high = float(pixels.min()), float(pixels.max())
            self._contrast[box] = low, high, max_structure(pixels) if low < high else 0.0
        return self._contrast[box]

    def refuse_blank(self, box: tuple[float, float, float, float] | None = None) -> None:
        """Raise ``image_blank`` if there is only noise in (x0, y0, x1, y1), or in the whole image if left out."""
        low, high, structure = self.contrast(box)
        where = f"{self.name}" if box is None else f"{self.name} in the region"
        remedy = "Check lens cap, light, exposure and that the specimen carries a pattern."
        if low == high:
            raise ImageError(f"{where} shows one grey level, {low:g}, everywhere.", code="image_blank", remedy=remedy)
        if structure < _MIN_STRUCTURE:
            raise ImageError(
                f"{where} shows noise only: neighbouring pixels correlate by {structure:.2f} at most, a pattern by "
                f"{_MIN_STRUCTURE:g} and more (grey levels {low:g} to {high:g}).",
                code="image_blank",
                remedy=remedy,
            )


def features_of(wanted: Sequence[tuple[MeasureImage, Box]], scale: int) -> list[Features]:
    """Return the keypoints of images within boxes (x0, y0, x1, y1), found on the first call for that box and scale."""
    new = [(image, box) for image, box in wanted if (box, scale) not in image._features]
    for (image, box), found in zip(
        new, detect_all([Picture(image.pixels, box) for image, box in new], scale=scale), strict=True
    ):
        image._features[box, scale] = found
    return [image._features[box, scale] for image, box in wanted]


def max_structure(pixels: NDArray[Any]) -> float:
    """Return the largest correlation between neighbouring pixels over tiles of 48 px, slow shading taken out.

    White camera noise gives 0 +- 0.02, a pattern that a camera resolves 0.5 and more. Tiles from the middle outwards;
    the search ends with the first that clearly has a pattern.
    """
    tile = min(_TILE, *pixels.shape)
    corners = [
        (y, x) for y in range(0, pixels.shape[0] - tile + 1, tile) for x in range(0, pixels.shape[1] - tile + 1, tile)
    ]
    middle = ((pixels.shape[0] - tile) / 2, (pixels.shape[1] - tile) / 2)
    corners.sort(key=lambda corner: (corner[0] - middle[0]) ** 2 + (corner[1] - middle[1]) ** 2)
    best = 0.0
    for y, x in corners:
        t = pixels[y : y + tile, x : x + tile].astype(np.float32)
        t = t - cv2.GaussianBlur(t, (0, 0), _BAND_PX, borderType=cv2.BORDER_REPLICATE)
        variance = float(np.mean(t * t))
        if variance > 1e-4:
            lag = 0.5 * float(np.mean(t[:, 1:] * t[:, :-1]) + np.mean(t[1:] * t[:-1]))
            best = max(best, lag / variance)
        if best > 2.0 * _MIN_STRUCTURE:
            break
    return best


def same_size(a: MeasureImage, b: MeasureImage) -> None:
    """Raise ``image_size_mismatch`` if two images of one camera differ in size."""
    if a.shape != b.shape:
        raise ImageError(
            f"{b.name} is {b.shape[1]} x {b.shape[0]} px, {a.name} is {a.shape[1]} x {a.shape[0]} px.",
            code="image_size_mismatch",
            remedy="Give images of one size per camera.",
        )


def different(a: MeasureImage, b: MeasureImage) -> None:
    """Raise ``same_image`` if both cameras' images are equal, grey level by grey level."""
    if _same(a, b):
        raise ImageError(
            f"{a.name} and {b.name} are the same image, grey level by grey level.",
            code="same_image",
            remedy="Give camera 1's image as camera 1 and camera 2's as camera 2.",
        )


def refuse_stale(ref1: MeasureImage, ref2: MeasureImage, current1: MeasureImage, current2: MeasureImage) -> None:
    """Raise ``stale_image`` if one camera's current image alone is its reference image, grey level by grey level.

    No camera takes the same noise twice: that image was never renewed. Matched with the other camera's it would give a
    smooth and wrong motion. Both cameras' references together are accepted: a test with zero motion.
    """
    stale = [_same(ref, now) for ref, now in ((ref1, current1), (ref2, current2))]
    if stale[0] != stale[1]:
        old = current1 if stale[0] else current2
        raise ImageError(
            f"{old.name} is its reference image, grey level by grey level, and the other camera's is not.",
            code="stale_image",
            remedy="One camera did not deliver a new image: take or copy this step's images again.",
        )


def _same(a: MeasureImage, b: MeasureImage) -> bool:
    if a.pixels is b.pixels:
        return True
    if a.shape != b.shape or not np.array_equal(a.pixels[::64], b.pixels[::64]):
        return False  # a few rows are enough, nearly always
    return bool(np.array_equal(a.pixels, b.pixels))


def check_calibrated_size(name: str, shape: tuple[int, ...], size_px: tuple[int, int] | None) -> None:
    """Raise ``image_size_mismatch`` if an image of (rows, cols) has not its calibration's (width, height), if known."""
    rows, cols = shape
    if size_px is not None and (cols, rows) != tuple(size_px):
        raise ImageError(
            f"{name} is {cols} x {rows} px, the calibration is for {size_px[0]} x {size_px[1]} px.",
            code="image_size_mismatch",
            remedy="Give the images of the calibrated cameras, uncropped and unscaled.",
        )


def _checked(image: NDArray[Any], name: str) -> NDArray[Any]:
    if image.ndim != 2 or min(image.shape) < _MIN_SIDE_PX:
        raise ImageError(
            f"{name} has the shape {image.shape}; it must be 2-D and {_MIN_SIDE_PX} px or more wide and high.",
            code="image_shape",
            remedy="Give one channel of grey levels.",
        )
    if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise ImageError(
            f"{name} holds {image.dtype}; grey levels must be uint8, uint16 or float.",
            code="image_type",
            remedy="Give the image as the camera delivered it.",
        )
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise ImageError(
            f"{name} holds {int((~np.isfinite(image)).sum())} NaN or infinite grey levels.",
            code="image_not_finite",
            remedy="Give the image as the camera delivered it.",
        )
    return np.ascontiguousarray(image)
