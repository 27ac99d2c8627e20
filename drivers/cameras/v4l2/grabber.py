"""The V4L2 camera: `stereorig.drivers.cameras.protocol.FrameGrabber` over the kernel's own interface."""

from __future__ import annotations

import math
import select
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraDescription, CameraOptions, CameraSettings, Frame
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.controls import Controls
from stereorig.drivers.cameras.v4l2.device import V4l2Device, closed, not_a_camera
from stereorig.drivers.cameras.v4l2.discovery import identity
from stereorig.drivers.cameras.v4l2.picture import PictureFormat
from stereorig.drivers.cameras.v4l2.settings import Setup
from stereorig.drivers.cameras.v4l2.stream import Counts, Stream, clock_of, probe_flags, stamp_error_ms, stamped_at

_COUNTER = (0, 2**32 - 1)
_PATIENCE_S = 0.5


class V4L2Grabber:
    """One V4L2 camera; see `stereorig.drivers.cameras.protocol.FrameGrabber`.

    Trigger modes: ``free`` always; ``hardware`` and ``software`` only if ``options.trigger_features`` names the
    controls that bring the device there, since V4L2 has no standard way. The one button among the features of
    ``software`` is pressed by `trigger`; the others are set.

    Parameters
    ----------
    options
        ``device`` is a node (``/dev/video0``) or, better, one of the stable links below ``/dev/v4l``.
    """

    def __init__(self, options: CameraOptions) -> None:
        self._options = options
        self._device: V4l2Device | None = None
        self._setup: Setup | None = None
        self._stream: Stream | None = None
        self._counts = Counts()
        self._flags = 0

    def open(self) -> None:
        """Open the node and read its abilities.

        Raises
        ------
        CameraError
            ``camera_lost``, ``camera_busy`` when another program streams, ``no_permission``, ``not_a_camera``,
            ``frame_format`` when it has no format with a brightness to read.
        """
        if self._device is not None:
            return
        device = V4l2Device(self._options.device).open()
        try:
            wanted = v.CAP_VIDEO_CAPTURE | v.CAP_VIDEO_CAPTURE_MPLANE
            if not device.capabilities & wanted or not device.capabilities & v.CAP_STREAMING:
                raise not_a_camera(device.path, "this node streams no pictures (a camera may have several nodes)")
            picture = PictureFormat(device)
            if not picture.gray_formats:
                picture.require_readable(picture.layout())
            self._flags = probe_flags(device, picture)
            self._setup = Setup(device, picture, Controls(device), self._options)
        except BaseException:
            device.close()
            raise
        self._counts = Counts()
        self._device = device

    @contextmanager
    def _opened(self) -> Iterator[tuple[V4l2Device, Setup]]:
        device, setup = self._device, self._setup
        if device is None or setup is None:
            raise closed(self._options.device)
        with device.use():
            yield device, setup

    def describe(self) -> CameraDescription:
        """Return the camera's identity and its abilities with its present format."""
        with self._opened() as (device, setup):
            known = identity(device.path, device.capability)
            return CameraDescription(
                model=known.model,
                serial=known.serial,
                image_size_px=setup.image_size(),
                bit_depths=tuple(sorted({one.bit_depth for one in setup.picture.gray_formats})),
                trigger_modes=setup.triggers.modes,
                exposure_range_ms=setup.exposure_range(),
                gain_range_db=None,
                frame_rate_range_hz=setup.rate_range(),
                driver="v4l2",
                firmware=known.firmware,
                clock=clock_of(self._flags),
                clock_error_ms=stamp_error_ms(self._flags),
                counter_range=_COUNTER,
                pixel_formats=tuple(one.name for one in setup.picture.gray_formats),
                feature_names=setup.controls.settable_names,
                extra={**known.extra, **setup.notes(), "timestamp": stamped_at(self._flags)},
            )

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the values that are not ``None`` and read everything back.

        Raises
        ------
        CameraError
            ``out_of_range``, ``unknown_feature``, ``read_only`` before anything was changed; ``armed``;
            ``setting_not_taken`` when the device has another value than the one set.
        """
        with self._opened() as (_, setup):
            setup.apply(settings, armed=self._stream is not None)
            return setup.read()

    def arm(self) -> None:
        """Take buffers and start the stream."""
        with self._opened() as (device, setup):
            if self._stream is None:
                setup.make_readable()
                self._stream = Stream(
                    device, setup.picture, setup.picture.layout(), self._options.buffers, self._counts
                )

    def disarm(self) -> None:
        """Stop the stream and give the buffers back."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with self._opened():
            stream.stop()

    def trigger(self) -> None:
        """Press the button of the software trigger; frames bear no number of it."""
        with self._opened() as (_, setup):
            setup.triggers.press(armed=self._stream is not None)

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame in ``poll``; `close` from another thread ends the wait."""
        deadline = time.monotonic() + timeout_s
        with self._opened() as (device, _):
            while True:
                stream = self._stream
                waiting = select.poll()
                waiting.register(device.wake, select.POLLIN)
                if stream is not None and stream.running:
                    waiting.register(device.fd, select.POLLIN)
                left = max(0.0, deadline - time.monotonic())
                events = dict(waiting.poll(math.ceil(left * 1000)))
                if device.closing:
                    raise closed(device.path)
                if stream is not None and device.fd in events:
                    frame = stream.take()
                    if frame is not None:
                        return frame
                    if stream.running and not events[device.fd] & select.POLLIN:
                        raise CameraError(
                            f"{device.path} reports an error on its stream and says no more.",
                            code="camera_lost",
                            remedy="Check its cable and power, then reconnect.",
                            device=device.path,
                        )
                if time.monotonic() >= deadline:
                    return None

    def statistics(self) -> dict[str, int | float]:
        """Return the counters of buffers in the ring, frames taken out, and damaged ones."""
        return asdict(self._counts)

    def close(self) -> None:
        """Release the device."""
        device, stream = self._device, self._stream
        self._device = self._setup = self._stream = None
        if device is not None:
            # a device that hangs may hold its driver for seconds: it then ends without us
            ending = threading.Thread(target=_end, args=(device, stream), name=f"closing {device.path}", daemon=True)
            ending.start()
            ending.join(_PATIENCE_S)


def _end(device: V4l2Device, stream: Stream | None) -> None:
    if stream is not None:
        with suppress(CameraError), device.use():
            stream.stop()
    device.close()
