"""The live measurement of a service: one at a time, since there is one pair of cameras."""

from __future__ import annotations

import threading
from typing import Any

from stereorig.core.errors import InputError, StateError
from stereorig.core.settings import NoiseRecord, Region, StoredSettings
from stereorig.server.base.errors import NotFoundError
from stereorig.server.compute.tasks import LiveTask
from stereorig.server.formats.images import read_image
from stereorig.server.formats.noise_json import load_noise
from stereorig.server.workflows.analysis.start import calibration_of, check_region
from stereorig.server.workflows.analysis.tasks import images_of
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.live.request import LiveSettings
from stereorig.server.workflows.live.run import LiveRun
from stereorig.server.workflows.service import Service


class LiveRuns:
    """Begins, finds and ends the live measurement of one service."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._lock = threading.Lock()
        self._run: LiveRun | None = None
        service.at_streams_end.append(self.end)

    @property
    def current(self) -> LiveRun | None:
        """The current run, or the one that ended last; None before any."""
        return self._run

    def begin(self, test_id: str, asked: LiveSettings) -> LiveRun:
        """Begin a live measurement of a test.

        Raises
        ------
        StateError
            ``live_running`` if one is running; ``not_calibrated``, ``no_steps``.
        RegionError, ImageError, InputError
            The region or a gauge cannot be used.
        """
        service = self._service
        with self._lock:
            if self._run is not None and self._run.active:
                raise StateError(
                    f"A live measurement of test {self._run.test_id} is running.",
                    code="live_running",
                    remedy="End it by POST /tests/{id}/live:stop first.",
                    test_id=self._run.test_id,
                )
            made_with = calibration_of(service, test_id, None)
            if asked.reference not in service.tests.steps.numbers(test_id):
                raise StateError(
                    f"Test {test_id} has no step {asked.reference} to refer to.",
                    code="no_steps",
                    remedy="Capture or import the reference first.",
                )
            reference = service.tests.steps.verified(test_id, asked.reference)
            check_same_cameras(made_with.file, service.rig.identities(), "A live frame")
            rows, cols = read_image(reference.cam1).shape
            settings = _stored(asked, (cols, rows))
            noise = None if asked.noise_id is None else service.noise.file(asked.noise_id)
            if noise is not None:
                record = NoiseRecord.model_validate({"noise_id": asked.noise_id, **load_noise(noise).record()})
                settings = settings.model_copy(update={"noise": record})
            check_region(service, test_id, asked.reference, settings, None)
            task = LiveTask(
                calibration=made_with.file,
                settings=settings,
                reference=images_of(asked.reference, reference),
                gauges=asked.plain_gauges(),
                whole_field=asked.field,
                audit_every=asked.audit_every,
                noise=noise,
            )
            shown = {
                **asked.model_dump(mode="json"),
                "region": settings.region.model_dump(mode="json", exclude={"mask"}),
            }
            run = LiveRun(
                test_id,
                task,
                shown,
                service.rig,
                threads=service.config.service.kernel_threads,
                silence_s=asked.silence_ms / 1e3,
                channels=service.channels,
            )
            self._run = run
            service.channels.attend(test_id)
            service.live_account = lambda: (run.account.counts(), run.active)
            run.start()
        return run

    def of(self, test_id: str) -> LiveRun:
        """Return the run of a test.

        Raises
        ------
        NotFoundError
            If it has none since the service's start.
        """
        run = self._run
        if run is None or run.test_id != test_id:
            raise NotFoundError(
                f"Test {test_id} is not measured live.", kind="live measurement", remedy="POST /tests/{id}/live."
            )
        return run

    def stop(self, test_id: str) -> LiveRun:
        """End the live measurement of a test; does nothing if it has ended already."""
        run = self.of(test_id)
        run.stop()
        return run

    def end(self) -> None:
        """End the current run without waiting for it: a signal's handler must not wait."""
        if self._run is not None:
            self._run.end()

    def close(self) -> None:
        """End the current run, and wait for it."""
        if self._run is not None:
            self._run.stop()


def _stored(asked: LiveSettings, size_px: tuple[int, int]) -> StoredSettings:
    """The settings of the measurement; without a region that about the gauges."""
    given: dict[str, Any] = {name: getattr(asked, name) for name in asked.measuring()}
    region = asked.region or _about_gauges(asked, size_px)
    return StoredSettings.model_validate(
        {**given, "region": region.model_dump(), "strain": None, "reference": asked.reference}
    )


def _about_gauges(asked: LiveSettings, size_px: tuple[int, int]) -> Region:
    from stereorig.core.field.region.lay_points import corners_px  # slow to load, and not every start needs it

    corners = [xy for point in asked.points for xy in point.positions()]
    corners += [xy for one in asked.extensometers for xy in one.positions()]
    for area in asked.areas:
        corners += corners_px(area.outline()).tolist()
    if not corners:
        raise InputError(
            "Neither a region nor a gauge is given.",
            code="region_empty",
            remedy="Give a gauge, or a region with field = true.",
        )
    margin, edge = 2 * asked.spacing_px, asked.subset_px // 2 + 1
    xs, ys = [x for x, _ in corners], [y for _, y in corners]
    box = (
        max(min(xs) - margin, edge),
        max(min(ys) - margin, edge),
        min(max(xs) + margin, size_px[0] - 1 - edge),
        min(max(ys) + margin, size_px[1] - 1 - edge),
    )
    return Region(rectangle=box)
