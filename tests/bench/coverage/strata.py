"""What laboratories' targets, stages, images and settings are like in the proof of coverage, stratum by stratum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Stratum:
    """One laboratory. Errors are drawn anew in each replicate; what the files declare is the same unless it says so.

    Attributes
    ----------
    tolerance_mm
        Bound of the nodes' errors, drawn alike within it.
    step_mm, scale
        Standard deviations of the stage's steps and of its scale.
    pitch
        Standard deviation of the pitch's scale.
    stage_off
        Relative error of the stages' travel, the same in each replicate and not declared.
    travel
        The stage's travel, over the usual one.
    tilt_rad
        Standard deviation of the stage axis' tilt, each way.
    declared_tilt_rad
        What the rig file says of it; None: nothing, so that the default prior holds.
    view_noise, view_noise_px
        Grey levels of the calibration's images, and over how many px it is correlated.
    free
        Checkerboard in free poses; else a line grid, each camera on its stage.
    reach
        Principal distance and stand-off, over the usual ones: with a long lens the views do not show the axis' tilt.
    lens
        k1, k2, p1, p2 of both cameras' lenses, and the model that the rig file asks for.
    noise, noise_px
        Grey levels of the measured images, and over how many px that is correlated.
    noise_2
        Grey levels of camera 2's measured images; None: those of camera 1.
    declare_white
        Measure the noise from repeated frames (``stereorig noise``) and give it: its file says nothing of correlation.
    columns, pixels
        Grey levels of the sensors' fixed pattern in the measured images, by column and by pixel.
    discs
        Sharp discs in place of soft speckle.
    curvature_per_mm
        Of the measured surface.
    neck_mm
        Of each step beside its motion, amplitude and width of a neck: displacement along x, amplitude tanh(x / width).
    blur_in_time
        Rises of the images' blur from the reference to the last step, px.
    subset_px, options
        Of ``stereorig measure``.
    must
        ``cover``: the asked limits hold; ``fail``: a negative control; ``state``: named on the page with its figures.
    """

    name: str
    tolerance_mm: float = 1e-3
    step_mm: float = 0.0
    scale: float = 0.0
    pitch: float = 0.0
    stage_off: float = 0.0
    travel: float = 1.0
    tilt_rad: float = 0.0
    declared_tilt_rad: float | None = 0.0
    view_noise: float = 2.0
    view_noise_px: float = 0.0
    free: bool = False
    reach: float = 1.0
    lens: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    lens_model: str = "paper"
    noise: float = 2.0
    noise_px: float = 0.0
    noise_2: float | None = None
    declare_white: bool = False
    columns: float = 0.0
    pixels: float = 0.0
    discs: bool = False
    curvature_per_mm: float = 0.0
    neck_mm: tuple[float, float] = (0.0, 2.0)
    blur_in_time: float = 0.0
    subset_px: int = 21
    options: tuple[str, ...] = ("--patch", "affine")
    main: bool = False
    must: Literal["cover", "fail", "state"] = "cover"


MAIN = (
    Stratum(name="exact grid", tolerance_mm=0.0, main=True),
    Stratum(name="grid of 1 um", main=True),
    Stratum(name="grid of 4 um", tolerance_mm=4e-3, main=True),
    Stratum(
        name="grid of 4 um, stage of 5 um and 1e-4, tilt of 1 mrad",
        tolerance_mm=4e-3,
        step_mm=5e-3,
        scale=1e-4,
        tilt_rad=1e-3,
        declared_tilt_rad=None,
        main=True,
    ),
)
OTHERS = (
    Stratum(name="stage of 1 um", step_mm=1e-3),
    Stratum(name="pitch of 2e-5", pitch=2e-5),
    Stratum(name="long lens, tilt of 1 mrad, default prior", tilt_rad=1e-3, declared_tilt_rad=None, reach=3.0),
    Stratum(name="noise of 6", noise=6.0, view_noise=6.0),
    Stratum(name="noise of 20", noise=20.0, view_noise=6.0),
    Stratum(name="correlated noise of the views", view_noise=6.0, view_noise_px=0.8),
    Stratum(name="board in free poses", tolerance_mm=2e-3, free=True, lens_model="auto"),
    Stratum(name="lens richer than the model", lens=(-0.6, 0.0, 1.5e-3, -2e-3), must="state"),
    Stratum(name="the same lens, model chosen", lens=(-0.6, 0.0, 1.5e-3, -2e-3), lens_model="auto", must="state"),
    Stratum(name="sensor pattern", columns=1.5, pixels=1.0),
    Stratum(name="sharp discs", discs=True, must="state"),
    Stratum(name="curved patch", curvature_per_mm=0.02, options=("--patch", "quadratic")),
    Stratum(name="subset of 15 px", subset_px=15),
    Stratum(name="subset of 33 px", subset_px=33),
    Stratum(name="reference updates", options=("--patch", "affine", "--reference-update", "always")),
    Stratum(name="localised strain", neck_mm=(0.3, 2.0), options=("--patch", "auto"), must="state"),
    Stratum(name="blur in time", blur_in_time=0.6, must="state"),
    Stratum(name="correlated noise of the images", noise=4.0, noise_px=0.45, must="state"),
    Stratum(name="the same, declared white", noise=4.0, noise_px=0.45, declare_white=True, must="state"),
)
# on so small a sensor 1 mrad is 0.06 um of a length of 10 mm, beside 0.4 um of noise: the control is a coarse one
CONTROLS = (Stratum(name="exact grid, axis off by 20 mrad, prior off", tolerance_mm=0.0, tilt_rad=2e-2, must="fail"),)
# after the others, whose draws follow from their places
LATER = (
    Stratum(name="contradicting scales", stage_off=0.05, must="fail"),
    Stratum(name="contradicting scales, lens chosen", stage_off=0.05, lens_model="auto", must="fail"),
    Stratum(name="short travel of the stage", travel=0.4),
    Stratum(name="camera 2 noisier", noise_2=8.0),
    Stratum(name="camera 1 noisier", noise=8.0, noise_2=2.0),
)
STRATA = MAIN + OTHERS + CONTROLS + LATER
