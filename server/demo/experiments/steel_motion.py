"""The ground plate moved as a rigid body: readings of gauges and strain in a motion without deformation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.demo.session import DemoCheck, DemoRun, Outcome, table
from stereorig.server.demo.strain import MICRO, chi_limit, fetched_strain
from stereorig.server.formats.gauges.readings import AreaStatistics, StepReadings

# name, translation (mm) and rotation (degrees about X_sys, Y_sys, Z_sys) of the plate, about the system's origin
MOTIONS = (
    ("shifted", (0.30, -0.20, 0.40), (0.0, 0.0, 0.0)),
    ("tilted", (0.0, 0.0, 0.0), (1.0, -0.5, 0.0)),
    ("turned and shifted", (-0.20, 0.10, 1.00), (0.5, 0.5, 2.0)),
)
STRAINS = ("exx", "eyy", "exy")
FALSE_LIMIT = 20.0  # microstrain, mean of the worst component: the project's own limit
OF_MANY = 4.0  # standard deviations that chance is given in the worst of many


@dataclass(frozen=True, eq=False)
class Moved:
    """One motion as it was measured.

    Attributes
    ----------
    name
        Name of the motion.
    found, sigma, true
        (6,) rotation vector in rad and translation of the points' middle in mm.
    sigma_calibration
        (6,) the calibration's part of sigma.
    noise_ratio
        Residual motion of the points, in units of its noise.
    elongation_mm, elongation_sigma_mm
        (n,) of extensometers over the plate.
    false_mean, false_mean_sigma, false_mean_calibration
        (3,) microstrain of exx, eyy, exy: mean of strain that is not there, as the service's area reads it, its sigma,
        and the calibration's part of that.
    false_sd, reported
        (3,) its standard deviation over the field, and the reported one.
    chi
        Root mean square of that strain in units of its own sigma.
    left
        Area statistics of u, v, w after the rigid motion and of strain, as the service gives them.
    """

    name: str
    found: Float
    sigma: Float
    sigma_calibration: Float
    true: Float
    noise_ratio: float
    elongation_mm: Float
    elongation_sigma_mm: Float
    false_mean: Float
    false_mean_sigma: Float
    false_mean_calibration: Float
    false_sd: Float
    reported: Float
    chi: float
    left: Mapping[str, AreaStatistics]


def capture(session: DemoRun, test: str) -> None:
    """Capture the moved plate, one step a motion."""
    for name, shift, degrees in MOTIONS:
        turn = np.radians(degrees).tolist()
        session.client.set_scene("steel", translation_mm=list(shift), rotation_rad=turn)
        session.client.capture(test, f"the plate {name}")


def measure(
    session: DemoRun, test: str, first: int, region: Mapping[str, Sequence[float]], folder: str, **settings: Any
) -> tuple[list[Moved], list[Field], list[StrainField]]:
    """Measure the motions of the steps from ``first`` on, and read the gauges over HTTP.

    Returns
    -------
    tuple
        The motions, and the steps' fields and strains.
    """
    steps = list(range(first, first + len(MOTIONS)))
    analysis = session.client.analyse(test, "displacement", region, steps=steps, **settings)
    fields = session.fetch(analysis, steps, folder)
    strains = fetched_strain(session, steps, folder)
    x0, y0, x1, y1 = region["rectangle"]
    dx, dy = 0.1 * (x1 - x0), 0.1 * (y1 - y0)
    ends = [
        ((x0 + dx, y0 + dy), (x1 - dx, y1 - dy)),
        ((x0 + dx, y1 - dy), (x1 - dx, y0 + dy)),
        ((x0 + dx, 0.5 * (y0 + y1)), (x1 - dx, 0.5 * (y0 + y1))),
    ]
    read = session.client.gauges(
        analysis,
        extensometers=[{"a_px": a, "b_px": b} for a, b in ends],
        areas=[{"name": "all"}],
        variables=["u_mm", "v_mm", "w_mm", *STRAINS],
        remove_rigid={},
        steps=steps,
    )
    moved = [_moved(motion, step, strain) for motion, step, strain in zip(MOTIONS, read, strains, strict=True)]
    return moved, fields, strains


def _moved(motion: tuple[str, Any, Any], step: StepReadings, strain: StrainField) -> Moved:
    name, shift, degrees = motion
    rigid = step.rigid_motion
    assert rigid is not None
    turn = Rotation.from_rotvec(degrees, degrees=True)
    middle = np.array(rigid.centre_mm)
    true = np.concatenate([turn.as_rotvec(), turn.apply(middle) + np.array(shift) - middle])
    values = [
        rigid.values[f"{quantity}_{axis}_{unit}"]
        for quantity, unit in (("rotation", "rad"), ("translation", "mm"))
        for axis in "xyz"
    ]
    elongation = [e.values["elongation_mm"] for e in step.extensometers]
    area = step.areas[0].values
    mean = MICRO * np.array([area[name].mean for name in STRAINS], dtype=np.float64)
    mean_sigma = MICRO * np.array([area[name].mean_sigma for name in STRAINS], dtype=np.float64)
    mean_calibration = MICRO * np.array([area[name].mean_sigma_calibration for name in STRAINS], dtype=np.float64)
    e, sigma = strain.strain[strain.valid], strain.sigma[strain.valid]
    return Moved(
        name=name,
        found=np.array([v.value for v in values]),
        sigma=np.array([v.sigma for v in values]),
        sigma_calibration=np.array([v.sigma_calibration for v in values], dtype=np.float64),
        true=true,
        noise_ratio=rigid.noise_ratio,
        elongation_mm=np.array([v.value for v in elongation]),
        elongation_sigma_mm=np.array([v.sigma for v in elongation]),
        false_mean=mean,
        false_mean_sigma=mean_sigma,
        false_mean_calibration=mean_calibration,
        false_sd=MICRO * e.std(axis=0),
        reported=MICRO * np.sqrt(np.mean(sigma**2, axis=0)),
        chi=float(np.sqrt(np.mean((e / sigma) ** 2))),
        left=area,
    )


def add_checks(outcome: Outcome, moved: list[Moved], strains: list[StrainField]) -> None:
    """Add the motions' tables, figures and limits to the experiment's outcome."""
    rows, false_rows = [], []
    for one in moved:
        off = one.found - one.true
        for part, quantity, unit, scale in ((slice(0, 3), "rotation", "urad", 1e6), (slice(3, 6), "shift", "um", 1e3)):
            both = scale * np.stack([off[part], one.sigma[part], one.sigma_calibration[part]], axis=-1)
            rows.append(
                [
                    one.name,
                    quantity,
                    unit,
                    *(f"{scale * v:.2f}" for v in one.true[part]),
                    *(f"{v:+.2f} +- {s:.2f} +- {c:.2f}" for v, s, c in both),
                ]
            )
        worst = int(np.argmax(np.abs(one.false_mean)))
        false = " +- ".join(
            [
                f"{one.false_mean[worst]:+.1f}",
                f"{one.false_mean_sigma[worst]:.1f}",
                f"{one.false_mean_calibration[worst]:.1f}",
            ]
        )
        elongations = " ".join(f"{1e3 * e:+.2f}" for e in one.elongation_mm)
        u, v, w = (np.nan if (sd := one.left[f"{c}_mm"].sd) is None else 1e3 * sd for c in "uvw")
        false_rows.append(
            [
                one.name,
                f"{one.noise_ratio:.2f}",
                f"{u:.2f} {v:.2f} {w:.2f}",
                elongations,
                f"{1e3 * float(np.max(one.elongation_sigma_mm)):.2f}",
                false,
                f"{one.false_sd[0]:.0f}",
                f"{one.reported[0]:.0f}",
                f"{one.chi:.2f}",
            ]
        )
    outcome.checks += [check for one, strain in zip(moved, strains, strict=True) for check in _checks(one, strain)]
    outcome.lines += [
        "",
        f"the plate moved as a rigid body ({len(strains)} steps), as the service's gauges read it:",
        *table(["motion", "", "", "true X", "Y", "Z", "off X", "Y", "Z"], rows),
        "",
        *table(
            [
                "motion",
                "noise ratio",
                "left: sd u v w, um",
                "extensometers, um",
                "sigma",
                "false strain, mean",
                "sd exx",
                "reported",
                "chi",
            ],
            false_rows,
        ),
        "",
        f"strain in microstrain over a gauge of {strains[0].gauge_mm:.2f} mm, the mean of the worst component; first "
        "sigma, then the calibration's part of it",
    ]
    outcome.data["rigid_motion"] = [
        {
            "name": one.name,
            "found": one.found.tolist(),
            "sigma": one.sigma.tolist(),
            "true": one.true.tolist(),
            "sigma_calibration": one.sigma_calibration.tolist(),
            "noise_ratio": one.noise_ratio,
            "elongation_mm": one.elongation_mm.tolist(),
            "elongation_sigma_mm": one.elongation_sigma_mm.tolist(),
            "left": {name: asdict(values) for name, values in one.left.items()},
            "false_strain_microstrain": {
                "mean": one.false_mean.tolist(),
                "mean_sigma": one.false_mean_sigma.tolist(),
                "mean_sigma_calibration": one.false_mean_calibration.tolist(),
                "sd": one.false_sd.tolist(),
                "reported": one.reported.tolist(),
                "chi": one.chi,
            },
        }
        for one in moved
    ]


def _checks(one: Moved, strain: StrainField) -> list[DemoCheck]:
    checks = []
    for part, quantity, unit, scale in ((slice(0, 3), "rotation", "urad", 1e6), (slice(3, 6), "shift", "um", 1e3)):
        found, true = (scale * float(np.linalg.norm(v[part])) for v in (one.found, one.true))
        off = scale * float(np.max(np.abs(one.found - one.true)[part]))
        limit = OF_MANY * scale * float(np.max(one.sigma[part]))
        checks.append(DemoCheck(f"the plate {one.name}: {quantity}, worst component", unit, found, true, off, limit))
    change = np.abs(one.elongation_mm) / one.elongation_sigma_mm
    k = int(np.argmax(change))
    elongation, worst = 1e3 * float(one.elongation_mm[k]), int(np.argmax(np.abs(one.false_mean)))
    mean = float(abs(one.false_mean[worst]))
    sigma = float(one.false_mean_sigma[worst])
    return [
        *checks,
        DemoCheck(
            f"the plate {one.name}: an extensometer that must not change",
            "um",
            elongation,
            0.0,
            elongation,
            OF_MANY * 1e3 * float(one.elongation_sigma_mm[k]),
        ),
        DemoCheck(
            f"the plate {one.name}: false strain, mean of the worst component",
            "microstrain",
            mean,
            None,
            mean,
            min(FALSE_LIMIT, OF_MANY * sigma),
        ),
        DemoCheck(f"the plate {one.name}: chi of the false strain", "", one.chi, None, one.chi, chi_limit(strain)),
    ]
