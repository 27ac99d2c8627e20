"""Speed of the image, from two frames of one camera: the error of a skew in pixels follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereorig.drivers.cameras.protocol import Frame

# Below it the peak of the correlation is one of many
_MIN_RESPONSE = 0.05
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-4)
_BLUR_PX = 5
_NOISE_PX = 0.02


@dataclass(frozen=True)
class ImageMotion:
    """Displacement of the middle of a camera's image in a time."""

    distance_px: float
    seconds: float

    @property
    def speed_px_s(self) -> float:
        """Mean speed."""
        return self.distance_px / self.seconds

    def within_px(self, skew_ms: float) -> float:
        """Return the least motion within a skew: the motion that the noise of two frames can feign is subtracted."""
        return max(0.0, self.distance_px - _NOISE_PX) * abs(skew_ms) / 1000.0 / self.seconds


def image_motion(first: Frame, last: Frame) -> ImageMotion | None:
    """Motion between two exposures of one camera, from the middle of its image.

    Returns
    -------
    ImageMotion or None
        None where the two frames have nothing in common, or the same device time.
    """
    seconds = (last.device_ns - first.device_ns) / 1e9
    if seconds <= 0.0 or first.pixels.shape != last.pixels.shape:
        return None
    one, two = (frame.pixels.astype(np.float32) for frame in (first, last))
    window = cv2.createHanningWindow((one.shape[1], one.shape[0]), cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(one, two, window)
    if not response > _MIN_RESPONSE:
        return None
    # the peak of a phase correlation is drawn towards whole pixels; alignment by gradients is not
    warp = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]], dtype=np.float32)
    try:
        # its stubs have no empty mask
        cv2.findTransformECC(one, two, warp, cv2.MOTION_TRANSLATION, _STOP, None, _BLUR_PX)  # type: ignore[call-overload]
    except cv2.error:
        return None
    return ImageMotion(float(np.hypot(warp[0, 2], warp[1, 2])), seconds)
