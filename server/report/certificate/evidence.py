"""The evidence of a certificate: every step that the plan names, with its measured and its known values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.calibration.checks.target_distance import check_target_images
from stereorig.core.certify.evidence import (
    CameraOffset,
    CheckedLength,
    Evidence,
    ExtensometerPoint,
    ExtensometerRun,
    MovedStep,
    StaticStep,
)
from stereorig.core.certify.measured import measured_of
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.target_toml import target_of
from stereorig.server.formats.channel_units import unit_of
from stereorig.server.formats.images import read_image
from stereorig.server.formats.manifest import known_sha256
from stereorig.server.report.certificate.readings import Readings, length_between, read_step
from stereorig.server.report.floor import static_steps
from stereorig.server.report.source import Source
from stereorig.server.results.calibration_checks import distance_of_target, uncertain_pair
from stereorig.server.results.certificate import plan as asked
from stereorig.server.results.channels import recorded_with
from stereorig.server.store.durable import known_json

_MM = {"mm": 1.0, "um": 1e-3}
_REMEDY = "Restore the file from a backup, or leave the values read from it out of the plan."


@dataclass(eq=False)
class Gathered:
    """The evidence, and the files that it was read from.

    Attributes
    ----------
    evidence
        All of it.
    static
        The static steps, as named or by their labels.
    images_sha256
        Checksums of pictures that were read in addition to the results, by name.
    pictured
        Steps whose pictures were read in addition to the results, with the checksums by camera.
    """

    evidence: Evidence
    static: list[int] = field(default_factory=list)
    images_sha256: dict[str, str] = field(default_factory=dict)
    pictured: dict[int, dict[str, str]] = field(default_factory=dict)


def gather(
    source: Source,
    plan: asked.CertificatePlan,
    *,
    folder: Path | None = None,
    on_step: Callable[[int, int], None] = lambda _done, _total: None,
) -> Gathered:
    """Read every step of a plan.

    Parameters
    ----------
    source
        The measurement.
    plan
        The known values of its steps.
    folder
        Folder of the plan's images; None: it may name none.
    on_step
        Called with the steps read and their number.

    Raises
    ------
    InputError
        ``certificate_step_missing``, ``certificate_step_unmeasured``, ``certificate_gauge_missing``,
        ``certificate_inputs_changed``.
    FileFormatError
        ``certificate_picture_missing``, ``certificate_picture_changed``.
    """
    if source.stale:
        raise InputError(
            f"The results do not belong to the stored data: {'; '.join(source.stale)}.",
            code="certificate_inputs_changed",
            remedy="Restore the images from a backup, or measure again; nothing was certified, nothing is lost.",
        )
    labels = {n: source.steps[n].label or source.heads[n].label for n in source.files}
    static, _ = static_steps(plan.static_steps, labels, source.reference)
    missing = sorted(n for n in plan.static_steps or () if n not in static)
    if missing:
        raise _no_step(missing[0], source)
    gathered = Gathered(Evidence(), static)
    wanted = _wanted(source, plan, static)
    at_rest: list[StaticStep] = []
    moved: list[MovedStep] = []
    lengths: list[CheckedLength] = []
    elongations: dict[int, tuple[float, float]] = {}
    gauge_length: float | None = None
    translations = {one.n: one for one in plan.translations}
    rotations = {one.n: one for one in plan.rotations}
    for k, n in enumerate(wanted):
        on_step(k, len(wanted))
        path = _result(source, n)
        step = read_step(n, path)
        if n in static:
            at_rest.append(StaticStep(n, _time(path, n, source), step.moved, step.scatter, step.mean_strain))
        if n in translations or n in rotations:
            moved.append(_moved(step, _time(path, n, source), translations.get(n), rotations.get(n), plan))
        for one in plan.lengths:
            if one.n == n and one.target is None:
                lengths.append(_between(step, one))
        ends = plan.extensometer
        if ends is not None and step.motion is not None:
            found = step.gauge(ends.a_px, ends.b_px)
            elongations[n] = found.elongation_mm.value, found.elongation_mm.sigma
            gauge_length = found.length0_mm.value
    for one in plan.lengths:
        if one.target is not None:
            lengths.append(_of_target(source, one, folder, gathered))
    gathered.evidence = Evidence(
        tuple(at_rest),
        tuple(moved),
        tuple(lengths),
        _extensometer(source, plan, static, elongations, gauge_length),
        _cameras(source, {*static, *translations, *rotations}),
    )
    return gathered


def _wanted(source: Source, plan: asked.CertificatePlan, static: list[int]) -> list[int]:
    """Steps whose results are read, ascending."""
    wanted = {*static, *(one.n for one in plan.translations), *(one.n for one in plan.rotations)}
    wanted |= {one.n for one in plan.lengths if one.n is not None and one.target is None}
    if plan.extensometer is not None:
        wanted |= {one.n for one in plan.extensometer.readings}
        wanted |= {n for n in source.files if n != source.reference} if plan.extensometer.channel else set()
    return sorted(wanted)


def _no_step(n: int, source: Source) -> InputError:
    return InputError(
        f"The plan names step {n}, which has no result to compare; there are {', '.join(map(str, source.files))}, "
        f"measured against step {source.reference}.",
        code="certificate_step_missing",
        remedy="Measure that step, or leave it out of the plan.",
    )


def _result(source: Source, n: int) -> Path:
    if n not in source.files:
        raise _no_step(n, source)
    return source.files[n]


def _time(path: Path, n: int, source: Source) -> float | None:
    return recorded_with(path.parent, n, source.reference).time_s


def _moved(
    step: Readings,
    time_s: float | None,
    translation: asked.Translation | None,
    rotation: asked.Rotation | None,
    plan: asked.CertificatePlan,
) -> MovedStep:
    motion = step.moved
    assert step.motion is not None
    shared = {"strain": step.mean_strain, "noise_ratio": step.motion.noise_ratio}
    if translation is not None:
        way = translation.translation_mm
        return MovedStep(
            step.n,
            time_s,
            motion,
            None if way is None else np.asarray(way, dtype=np.float64),
            translation.distance_mm,
            translation.u_mm,
            plan.stage_scale_u,
            **shared,  # type: ignore[arg-type]
        )
    assert rotation is not None
    angle = None if rotation.angle_deg is None else float(np.radians(rotation.angle_deg))
    sigma = float(np.radians(rotation.u_deg))
    return MovedStep(
        step.n,
        time_s,
        motion,
        angle_rad=angle,
        sigma_rad=sigma,
        rotation=True,
        **shared,  # type: ignore[arg-type]
    )


def _between(step: Readings, one: asked.KnownLength) -> CheckedLength:
    assert one.a_px is not None
    assert one.b_px is not None
    assert one.length_mm is not None
    found = step.gauge(one.a_px, one.b_px)
    reading = found.length0_mm if step.motion is None else found.length_mm
    return length_between(one.name, reading, known_mm=one.length_mm, sigma_mm=one.u_mm, artefact=one.artefact)


def _of_target(source: Source, one: asked.KnownLength, folder: Path | None, gathered: Gathered) -> CheckedLength:
    """Measure a target of known size in a pair of pictures; its own uncertainty counts as new at each place."""
    assert one.target is not None
    if source.calibration is None:
        raise InputError(
            f"{one.name}: the calibration that was measured with is not there, so no target can be measured.",
            code="calibration_missing",
            remedy="Give it with --calibration.",
        )
    images = _pictures(source, one, folder, gathered)
    target = target_of(one.target.plain(), "lengths.target")
    found = distance_of_target(source.calibration, images, target, distance_sigma_mm=one.u_mm)
    bare = check_target_images(source.calibration.pair, images, target, distance_sigma_mm=one.u_mm)
    value, own = np.array([found.measured_mm]), np.array([[bare.sigma_mm**2]])
    common = None
    if uncertain_pair(source.calibration).covariance is not None:
        # the calibration adds one error that all places share
        common = np.array([[float(np.sqrt(max(found.sigma_mm**2 - bare.sigma_mm**2, 0.0)))]])
    return CheckedLength(one.name, measured_of(value, own, None, common), found.known_mm, 0.0, one.artefact or one.name)


def _pictures(
    source: Source, one: asked.KnownLength, folder: Path | None, gathered: Gathered
) -> tuple[NDArray[Any], NDArray[Any]]:
    paths: dict[str, Path] = {}
    recorded: dict[str, str] = {}
    if one.images is not None:
        if folder is None:
            raise InputError(
                f"{one.name}: files cannot be named here.",
                code="option_conflict",
                remedy="Import the pair as a step of the test, and give its number.",
            )
        paths = {cam: folder / getattr(one.images, cam) for cam in CAMERAS}
    else:
        assert one.n is not None
        if source.test is None:
            raise _no_step(one.n, source)
        home = source.test / "steps" / f"{one.n:04d}"
        paths = {cam: home / f"{cam}.tif" for cam in CAMERAS}
        found = known_json(home / "step.json").get("sha256")
        recorded = found if isinstance(found, dict) else {}
    for cam, path in paths.items():
        if not path.is_file():
            raise FileFormatError(
                f"{one.name}: the picture {path.name} of {cam} is not there ({path.parent.name}).",
                code="certificate_picture_missing",
                remedy=_REMEDY,
                camera=cam,
            )
        digest = known_sha256(path)
        if recorded.get(cam, digest) != digest:
            raise FileFormatError(
                f"{one.name}: the picture {path.name} of {cam} is not the one that was recorded.",
                code="certificate_picture_changed",
                remedy=_REMEDY,
                camera=cam,
            )
        gathered.images_sha256[f"{one.name}, {cam}"] = digest
        if one.n is not None:
            gathered.pictured.setdefault(one.n, {})[cam] = digest
    return read_image(paths["cam1"]), read_image(paths["cam2"])


def _extensometer(
    source: Source,
    plan: asked.CertificatePlan,
    static: list[int],
    elongations: dict[int, tuple[float, float]],
    gauge_length_mm: float | None,
) -> ExtensometerRun | None:
    reference = plan.extensometer
    if reference is None:
        return None
    true = {one.n: one.elongation_mm for one in reference.readings}
    if reference.channel is not None:
        recorded = {n: recorded_with(source.files[n].parent, n, source.reference) for n in elongations}
        units = {one.units.get(reference.channel, unit_of(reference.channel)) for one in recorded.values()}
        factor = _MM.get(units.pop()) if len(units) == 1 else None
        if factor is None:
            raise InputError(
                f"The channel {reference.channel!r} has no unit of length in its name.",
                code="certificate_channel_unit",
                remedy="Name a channel that ends in _mm or _um.",
            )
        for n in elongations:
            value = recorded[n].channels.get(reference.channel)
            if value is not None and n not in static:
                true[n] = factor * value
    if not true:
        raise InputError(
            "No step has a reading of the reference extensometer.",
            code="certificate_step_missing",
            remedy="Record the channel with the steps, or give readings in the plan.",
        )
    points = tuple(ExtensometerPoint(n, true[n], reference.u_mm, *elongations[n]) for n in sorted(true))
    at_rest = tuple(elongations[n][0] for n in static if n in elongations)
    return ExtensometerRun(points, at_rest, gauge_length_mm, reference.gauge_length_mm)


def _cameras(source: Source, steps: set[int]) -> tuple[CameraOffset, ...]:
    found = []
    for n, motion in sorted(source.camera_motion.items()):
        for against in ("calibration", "reference") if n in steps or n == source.reference else ():
            one = getattr(motion, against)
            if one is not None:
                found.append(CameraOffset(n, against, one.camera_moved, one.offset_rms_px, one.expected_px, one.sigmas))
    return tuple(found)
