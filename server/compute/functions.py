"""Functions that an executor runs: a task in, plain values out.

They import the numerical modules when they are called, so that only the worker's process loads the kernels, after it
has set the numbers of threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereorig.server.compute.tasks import (
        FitTask,
        GuideTask,
        LiveCheckTask,
        LiveFinding,
        LiveTask,
        LookTask,
        NoiseTask,
        Plain,
        RepairTask,
        StepTask,
    )
    from stereorig.server.worker.shared_images import Placed


def warm_up(threads: int) -> None:
    """Load every kernel once, before the first task needs them; missing ones are compiled in other processes."""
    from stereorig.server.compute import measurement

    measurement.warm_up(threads)


def measure_step(task: StepTask) -> Plain:
    """Measure one step; its result file is readable when this returns. Returns the step's summary."""
    from stereorig.server.compute import measurement

    measurement.await_kernels(motion=task.step.n != task.reference.n)
    return measurement.measure_step(task)


def fit_calibration(task: FitTask) -> Plain:
    """Find the grid in every view and fit both cameras; ``calibration.json`` is there when this returns."""
    from stereorig.server.compute.calibration import fit

    return fit.fit_calibration(task)


def repair_calibration(task: RepairTask) -> Plain:
    """Estimate the cameras' orientation again; the new ``calibration.json`` is there when this returns."""
    from stereorig.server.compute import measurement, orientation_repair

    measurement.await_kernels()
    return orientation_repair.repair_calibration(task)


def find_in_pair(task: LookTask) -> dict[str, int]:
    """Find the target in both images; raises as the fit would. Returns the number of points found by camera."""
    from stereorig.server.compute.calibration import guide_session

    return guide_session.find_in_pair(task)


def check_live(task: LiveCheckTask) -> LiveFinding:
    """Return the distance of a live pair's points from their epipolar lines."""
    from stereorig.server.compute import live_check, measurement

    measurement.await_kernels()
    return live_check.check_live(task)


def begin_live(task: LiveTask) -> Plain:
    """Measure the reference of a live measurement; frames can follow. Returns the grid of its points."""
    from stereorig.server.compute import measurement
    from stereorig.server.compute.live import frames

    measurement.await_kernels()
    return frames.begin(task)


def measure_live(pixels: Placed, time_s: float) -> Plain:
    """Measure a frame of the live measurement that was begun; returns readings and counts of points by status."""
    from stereorig.server.compute.live import frames

    image1, image2 = pixels.read()
    return frames.measure((image1, image2), time_s)


def look_at_pair(task: GuideTask, pixels: Plain, serial: int) -> Plain:
    """Find the target coarsely in a live pair, and say whether it is at rest and new."""
    from stereorig.server.compute.calibration import guide_session

    return guide_session.look_at_pair(task, pixels, serial)


def guide_views(task: GuideTask, views: list[Plain]) -> Plain:
    """Add new views, and return the cover by all of them and the next view to take."""
    from stereorig.server.compute.calibration import guide_session

    return guide_session.guide_views(task, views)


def fit_noise(task: NoiseTask) -> Plain:
    """Fit both cameras' noise models; ``noise.json`` is there when this returns."""
    from stereorig.server.compute import noise_fit

    return noise_fit.fit_noise(task)
