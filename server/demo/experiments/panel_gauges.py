"""Gauges on the cracked panel: the crack's opening and the buckle's shape, measured and true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.server.demo.client import AnalysisHandle
from stereorig.server.demo.session import DemoCheck, DemoRun, Outcome, table
from stereorig.server.demo.strain import SAFE
from stereorig.sim.catalog import make_scene
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import Truth, truth_at

ACROSS = tuple(round(0.15 * k, 2) for k in range(-6, 7))  # of the half crack: positions of the extensometers
BEYOND = (-1.35, 1.35)  # the same, ahead of the tips: nothing opens there
ENDS_PX = 15.0  # from the crack: half a subset, and half a step for the points about it
CREST_FROM_KN = 20.0  # below it the panel has not buckled
OF_MANY = 4.0  # standard deviations that chance is given in the worst of many
_CREST_MM = 12.0  # a parabola holds that far from a crest


@dataclass(frozen=True, eq=False)
class CrackOpening:
    """Virtual extensometers across the crack in every step with a displacement.

    Attributes
    ----------
    position
        (n,) along the crack, of its half length; beyond +-1 ahead of the tips.
    found, sigma
        (steps, n) elongation, mm; NaN for missing readings.
    true
        (steps, n) of the same ends.
    lips
        (steps, n) true opening of the lips in the panel's plane, zero beyond the tips.
    parting, parting_sigma, parting_true
        (steps, n) by how much the ends part out of the plane.
    """

    position: Float
    found: Float
    sigma: Float
    true: Float
    lips: Float
    parting: Float
    parting_sigma: Float
    parting_true: Float


@dataclass(frozen=True, eq=False)
class Slice:
    """Displacement towards the cameras along a line of the image, in every step with a displacement.

    Attributes
    ----------
    xy_px, at_mm
        (m, 2) its positions, px; (m,) their true coordinate along the load or along the crack, mm.
    found, sigma, true
        (steps, m) mm; the first two NaN for missing readings.
    """

    xy_px: Float
    at_mm: Float
    found: Float
    sigma: Float
    true: Float


@dataclass(frozen=True)
class Crest:
    """Top of a parabola through the points about a slice's highest one."""

    height_mm: float
    at_mm: float


def read_opening(
    session: DemoRun, analysis: AnalysisHandle, crack_px: Float, panel: CrackedPanel, loads_kn: Sequence[float]
) -> CrackOpening:
    """Put extensometers across the crack and read them over HTTP."""
    position = np.array([BEYOND[0], *ACROSS, BEYOND[1]])
    middle, half = 0.5 * (crack_px[0] + crack_px[-1]), 0.5 * (crack_px[-1] - crack_px[0])
    on = middle + position[:, None] * half
    reach = np.array([0.0, ENDS_PX])  # the load runs down in the images
    ends = np.stack([on - reach, on + reach], axis=1)
    gauges = [{"a_px": a.tolist(), "b_px": b.tolist()} for a, b in ends]
    points = [{"xy_px": xy.tolist()} for xy in ends.reshape(-1, 2)]
    steps = session.client.gauges(analysis, extensometers=gauges, points=points, variables=["w_mm"])[1:]
    elongations = [[e.values["elongation_mm"] for e in s.extensometers] for s in steps]
    found = _numbers([[e.value for e in of_step] for of_step in elongations])
    sigma = _numbers([[e.sigma for e in of_step] for of_step in elongations])
    depths = [[p.values["w_mm"] for p in s.points] for s in steps]
    w = _numbers([[p.value for p in of_step] for of_step in depths]).reshape(len(steps), -1, 2)
    w_sigma = _numbers([[p.sigma for p in of_step] for of_step in depths]).reshape(len(steps), -1, 2)
    truths = [true_panel(session.rig, ends, load) for load in loads_kn]
    s_mm = truths[0].st_mm[..., 0].mean(axis=1)
    lens = np.sqrt(np.clip(panel.half_crack_mm**2 - s_mm**2, 0.0, None))
    lips = [4.0 * panel.stress_mpa(load) * lens / panel.youngs_modulus_mpa for load in loads_kn]
    return CrackOpening(
        position=position,
        found=found,
        sigma=sigma,
        true=np.array([_elongation(t) for t in truths]),
        lips=np.array(lips),
        parting=w[..., 1] - w[..., 0],
        parting_sigma=np.hypot(w_sigma[..., 0], w_sigma[..., 1]),
        parting_true=np.array([t.uvw_mm[:, 1, 2] - t.uvw_mm[:, 0, 2] for t in truths]),
    )


def read_slice(
    session: DemoRun, analysis: AnalysisHandle, ends_px: Float, loads_kn: Sequence[float], axis: int
) -> Slice:
    """Read w along a line over HTTP; ``axis`` 0: given along the crack, 1: along the load."""
    line = {"vertices_px": np.asarray(ends_px).tolist()}
    steps = session.client.gauges(analysis, lines=[line], variables=["w_mm"])[1:]
    first = steps[0].lines[0]
    xy = np.stack([first.x_px, first.y_px], axis=-1)
    depths = [s.lines[0].values["w_mm"] for s in steps]
    found, sigma = _numbers([w.value for w in depths]), _numbers([w.sigma for w in depths])
    truths = [true_panel(session.rig, xy, load) for load in loads_kn]
    true = np.array([-t.uvw_mm[..., 2] for t in truths])
    return Slice(xy, truths[0].st_mm[:, axis], -found, sigma, true)


def crests(at_mm: Float, height_mm: Float) -> list[Crest]:
    """Find the highest position on each side of zero, by a parabola through the points about it."""
    out = []
    for side in (-1.0, 1.0):
        use = np.isfinite(height_mm) & (side * at_mm > 0.0)
        x, y = at_mm[use], height_mm[use]
        near = np.abs(x - x[np.argmax(y)]) < _CREST_MM
        c0, c1, c2 = np.polynomial.polynomial.polyfit(x[near], y[near], 2)
        top = -0.5 * c1 / c2
        out.append(Crest(float(c0 + 0.5 * c1 * top), float(top)))
    return out


def plane_patch_error_mm(rig: SimRig, camera1: Camera, xy_px: Float, load_kn: float, subset_px: int) -> Float:
    """Error of a plane patch in the true w at positions (n, 2): half its curvature times the subset's second moment.

    The same as the mean of w over the subset less w in its middle, up to second order; so it is summed.
    """
    side = np.arange(subset_px) - subset_px // 2
    offset = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    pixels = np.asarray(xy_px)[:, None] + offset
    reference, now = make_scene(rig, "panel"), make_scene(rig, "panel", load=load_kn)
    w = -truth_at(reference, camera1, pixels, now=now).uvw_mm[..., 2]
    return np.asarray(w.mean(axis=1) - w[:, len(offset) // 2])


def add_checks(
    outcome: Outcome, opening: CrackOpening, up: Slice, loads_kn: Sequence[float], rig: SimRig, subset_px: int
) -> None:
    """Add the opening's and the buckle's tables, figures and limits to the experiment's outcome."""
    open_rows, crest_rows = [], []
    middle = len(opening.position) // 2
    crest_data = []
    for k, load in enumerate(loads_kn):
        off = (opening.found - opening.true)[k]
        chi = float(np.sqrt(np.mean((off / opening.sigma[k]) ** 2)))
        parting = (opening.parting - opening.parting_true)[k] / opening.parting_sigma[k]
        open_rows.append(
            [
                f"{load:g}",
                f"{1e3 * opening.found[k, middle]:.1f} +- {1e3 * opening.sigma[k, middle]:.1f}",
                f"{1e3 * opening.true[k, middle]:.1f}",
                f"{1e3 * opening.lips[k, middle]:.1f}",
                f"{1e3 * float(np.sqrt(np.mean(off**2))):.1f}",
                f"{chi:.2f}",
                f"{1e3 * opening.parting[k, middle]:.0f}",
                f"{1e3 * opening.parting_true[k, middle]:.0f}",
                f"{float(np.sqrt(np.mean(parting**2))):.2f}",
            ]
        )
        found, true = (
            crests(up.at_mm, up.found[k]),
            crests(up.at_mm, np.where(np.isnan(up.found[k]), np.nan, up.true[k])),
        )
        crest_data.append({"found": [vars(c) for c in found], "true": [vars(c) for c in true]})
        if load < CREST_FROM_KN:
            continue
        top = [int(np.nanargmin(np.abs(up.at_mm - c.at_mm))) for c in true]
        bend = plane_patch_error_mm(rig, rig.cam1.camera, up.xy_px[top], load, subset_px)
        for side, f, t, b, i in zip(("upper", "lower"), found, true, bend, top, strict=True):
            limit = SAFE * float(up.sigma[k, i]) + abs(float(b))
            off_mm = f.height_mm - t.height_mm
            crest_rows.append(
                [
                    f"{load:g}",
                    side,
                    f"{f.height_mm:+.4f}",
                    f"{t.height_mm:+.4f}",
                    f"{1e3 * off_mm:+.1f}",
                    f"{1e3 * float(b):+.1f}",
                    f"{f.at_mm:+.1f}",
                    f"{t.at_mm:+.1f}",
                ]
            )
            if k == len(loads_kn) - 1:
                name = f"{side} crest of the buckle at {load:g} kN"
                outcome.checks.append(DemoCheck(name, "mm", f.height_mm, t.height_mm, off_mm, limit))
    inside, last = np.abs(opening.position) < 1.0, loads_kn[-1]
    worst = np.nanmax(np.abs(opening.found - opening.true)[-1]) if np.isfinite(opening.found).all() else np.nan
    sigma = float(np.max(opening.sigma[-1]))
    outcome.checks += [
        DemoCheck(
            f"crack opening in the middle at {last:g} kN",
            "mm",
            float(opening.found[-1, middle]),
            float(opening.true[-1, middle]),
            float((opening.found - opening.true)[-1, middle]),
            SAFE * float(opening.sigma[-1, middle]),
        ),
        DemoCheck(
            f"crack opening at {last:g} kN, worst of {inside.sum()} positions and of 2 ahead of the tips",
            "mm",
            float(worst),
            None,
            float(worst),
            OF_MANY * sigma,
        ),
    ]
    outcome.lines += [
        "",
        f"extensometers over the crack, ends {ENDS_PX:g} px off it; in its middle and all {len(opening.position)}:",
        *table(["kN", "opening um", "true", "lips", "rms off", "chi", "parts by um", "true", "chi"], open_rows),
        "",
        "crests of the buckle on the line along the load through the crack's middle, w towards the cameras:",
        *table(["kN", "crest", "mm", "true mm", "off um", "plane patches", "at mm", "true"], crest_rows),
    ]
    outcome.data["opening"] = {
        name: (1e3 * getattr(opening, name)).tolist() for name in ("found", "sigma", "true", "lips", "parting")
    } | {"position": opening.position.tolist(), "unit": "um"}
    off = up.found - up.true
    outcome.data["buckle"] = {
        "crests": crest_data,
        "rms_off_um": [1e3 * float(np.sqrt(np.nanmean(v**2))) for v in off],
        "sigma_um": [1e3 * float(np.sqrt(np.nanmean(v**2))) for v in up.sigma],
    }


def true_panel(rig: SimRig, xy_px: Float, load_kn: float) -> Truth:
    """Truth of the panel at pixels of camera 1, from no load to ``load_kn``."""
    return truth_at(make_scene(rig, "panel"), rig.cam1.camera, xy_px, now=make_scene(rig, "panel", load=load_kn))


def _elongation(truth: Truth) -> Float:
    """Elongation (n,) between pairs (n, 2) of points."""
    before, after = truth.xyz_mm, truth.xyz_mm + truth.uvw_mm
    length = [np.linalg.norm(p[:, 1] - p[:, 0], axis=-1) for p in (before, after)]
    return np.asarray(length[1] - length[0])


def _numbers(values: Sequence[Sequence[float | None]]) -> Float:
    """Return lists of numbers as an array, NaN for missing ones."""
    return np.array(values, dtype=np.float64)
