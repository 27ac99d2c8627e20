"""Measurements of a verification procedure, and the known values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stereorig.core.arrays import Float
from stereorig.core.certify.measured import Measured


@dataclass(frozen=True)
class ScatterEvidence:
    """A quantity over the points of one static step.

    Attributes
    ----------
    mean, sd
        Over the points; the standard deviation is about the mean.
    reported
        Root mean square of the points' own standard uncertainties: without the common part, which no scatter shows.
    points
        Number of points.
    independent
        Number of independent values: points whose subsets or windows overlap count for less.
    """

    mean: float
    sd: float
    reported: float
    points: int
    independent: float


@dataclass(frozen=True, eq=False)
class StaticStep:
    """A step in which nothing moved since the reference.

    Attributes
    ----------
    n
        Its number.
    time_s
        Seconds since the reference; None if it is not known.
    motion
        (6,) small rotation (rad) and translation (mm) of the field.
    scatter
        By quantity: ``u_mm`` and others in mm, ``exx`` and others without unit.
    strain
        (3,) means of exx, eyy, exy; None without strain.
    """

    n: int
    time_s: float | None
    motion: Measured
    scatter: Mapping[str, ScatterEvidence] = field(default_factory=dict)
    strain: Measured | None = None


@dataclass(frozen=True, eq=False)
class MovedStep:
    """A step in which a rigid body was moved by a known way, a known angle, or by an unknown one.

    Attributes
    ----------
    n, time_s, motion, strain
        As of :class:`StaticStep`.
    translation_mm
        (3,) the known way since the reference, system frame; None if its direction is not known.
    distance_mm
        The known length of the way, of unknown direction.
    sigma_mm
        Standard uncertainty of the known way, of each component, new at each step.
    sigma_scale
        Relative standard uncertainty of the stage's scale, which all its ways share.
    angle_rad, sigma_rad
        The known angle and its standard uncertainty; None of a rotation by hand.
    rotation
        True for a rotation, False for a translation.
    noise_ratio
        Root mean square of the field's residuals after the rigid motion, over their expected noise.
    """

    n: int
    time_s: float | None
    motion: Measured
    translation_mm: Float | None = None
    distance_mm: float | None = None
    sigma_mm: float = 0.0
    sigma_scale: float = 0.0
    angle_rad: float | None = None
    sigma_rad: float = 0.0
    rotation: bool = False
    strain: Measured | None = None
    noise_ratio: float = float("nan")


@dataclass(frozen=True, eq=False)
class CheckedLength:
    """A length that is known from elsewhere, as it was measured at one place.

    Attributes
    ----------
    name
        Place and artefact.
    measured
        (1,) mm.
    known_mm, sigma_mm
        The length, and its standard uncertainty.
    artefact
        Lengths of one artefact share its uncertainty.
    """

    name: str
    measured: Measured
    known_mm: float
    sigma_mm: float = 0.0
    artefact: str = ""


@dataclass(frozen=True)
class ExtensometerPoint:
    """The virtual extensometer and the reference extensometer in one step.

    Attributes
    ----------
    n
        The step.
    true_mm, sigma_true_mm
        The reference's elongation and its standard uncertainty.
    indicated_mm, sigma_mm
        The virtual extensometer's.
    """

    n: int
    true_mm: float
    sigma_true_mm: float
    indicated_mm: float
    sigma_mm: float


@dataclass(frozen=True)
class ExtensometerRun:
    """A series of points, the elongations of the static steps, and the gauge length.

    Attributes
    ----------
    points
        In the order of their taking.
    static_mm
        Elongations read while nothing moved; they give the resolution.
    gauge_length_mm, known_gauge_length_mm
        As measured, and as stated; None if it was not stated.
    """

    points: tuple[ExtensometerPoint, ...]
    static_mm: tuple[float, ...] = ()
    gauge_length_mm: float | None = None
    known_gauge_length_mm: float | None = None


@dataclass(frozen=True)
class CameraOffset:
    """Result of a step's epipolar offsets: see :class:`stereorig.core.orientation.OffsetFinding`."""

    n: int
    against: str
    moved: bool | None
    offset_px: float
    expected_px: float
    sigmas: float


@dataclass(frozen=True)
class Evidence:
    """All evidence of a procedure.

    Attributes
    ----------
    static, moved, lengths, extensometer, cameras
        Its parts; empty or None if they were left out.
    """

    static: tuple[StaticStep, ...] = ()
    moved: tuple[MovedStep, ...] = ()
    lengths: tuple[CheckedLength, ...] = ()
    extensometer: ExtensometerRun | None = None
    cameras: tuple[CameraOffset, ...] = ()

    @property
    def calibration_known(self) -> bool:
        """True if every measured number holds the calibration's uncertainty."""
        numbers = [s.motion for s in self.static] + [s.motion for s in self.moved]
        numbers += [one.measured for one in self.lengths]
        return all(number.common is not None for number in numbers)

    @property
    def translations(self) -> tuple[MovedStep, ...]:
        """Steps of a known way."""
        return tuple(s for s in self.moved if s.translation_mm is not None or s.distance_mm is not None)

    @property
    def rotations(self) -> tuple[MovedStep, ...]:
        """Steps of a rotation."""
        return tuple(s for s in self.moved if s.rotation)
