"""What the command line's files say of a replicate beside its truth: errors, and the uncertainty that they state.

Files are read with netCDF4 and json alone, by the contract of their documents.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from netCDF4 import Dataset
from scipy.spatial.transform import Rotation

from tests.bench.coverage.chain import ENDS, INSIDE, Run
from tests.bench.coverage.draw import Replicate
from tests.bench.coverage.render import Array

WITHIN = 1.959964
SHAPE = "shape"
OFF = "calibration's part off"
MEAN = "mean of all steps"
WHITE = "declared white in time: mean of all steps"


@dataclass(frozen=True)
class Frame:
    """From the world that a replicate is drawn in to the system's frame of its calibration: x' = R x + t."""

    R: Array
    t: Array

    def point(self, x: Array) -> Array:
        """Points (..., 3) in the system's frame."""
        return np.asarray(x @ self.R.T + self.t)

    def way(self, x: Array) -> Array:
        """Directions and displacements (..., 3)."""
        return np.asarray(x @ self.R.T)


class Tally:
    """Sums by cell of one replicate: count, within 95 %, squares of error over sigma, of errors, of sigmas."""

    def __init__(self) -> None:
        self.cells: dict[str, list[float]] = {}

    def add(self, motion: str, quantity: str, error: Any, sigma: Any) -> None:
        """Add values with their standard uncertainties; those that are missing are left out."""
        error, sigma = np.ravel(np.asarray(error, float)), np.ravel(np.asarray(sigma, float))
        known = np.isfinite(error) & np.isfinite(sigma) & (sigma > 0.0)
        if not known.any():
            return
        e, s = error[known], sigma[known]
        z = e / s
        sums = [len(z), int((np.abs(z) <= WITHIN).sum()), float(z @ z), float(e @ e), float(s @ s)]
        cell = self.cells.setdefault(f"{motion}|{quantity}", [0.0] * 5)
        self.cells[f"{motion}|{quantity}"] = [a + b for a, b in zip(cell, sums, strict=True)]


def scored(replicate: Replicate, run: Run) -> dict[str, list[float]]:
    """Cells of a replicate, by motion and quantity."""
    tally = Tally()
    frame = _frame(replicate, run)
    with Dataset(run.folder / "results" / "step_0000.nc") as data:
        px = _values(data, ("x_px", "y_px"))
        world = replicate.sheet.seen_by(replicate.cameras[0], px)
        _positions(tally, data, frame.point(world))
    _shape_gauges(tally, run, px, frame.point(world))
    steps: list[Step] = []
    for k, (name, A, b) in enumerate(replicate.motions, start=1):
        neck = replicate.stratum.neck_mm
        moved = frame.way(replicate.sheet.necked(world, neck) @ A.T + b - world)
        with Dataset(run.folder / "results" / f"step_{k:04d}.nc") as data:
            _motion(tally, name, data, moved)
            step = _step(data, moved)
            if steps and step is not None:
                _difference(tally, name, steps[0], step)
            steps += [step] if step is not None else []
            if "exx" in data.variables and not neck[0]:
                _strain(tally, name, data, _true_strain(replicate, frame, world, A))
        _gauges(tally, name, run.gauges["steps"][k], px, frame.point(world), moved)
        if not neck[0]:
            _rigid(tally, name, run.moved, k, frame, world, A, b)
    if len(steps) == len(replicate.motions):
        _mean(tally, steps)
    return tally.cells


def _frame(replicate: Replicate, run: Run) -> Frame:
    """The system's frame: the target's at the first position, or in the free pose that the calibration chose."""
    if not replicate.stratum.free:
        return Frame(np.eye(3), np.zeros(3))
    content = json.loads((run.folder / "calibration.json").read_text(encoding="utf-8"))
    place = np.array([content["cam1"][name] for name in ("x0_mm", "y0_mm", "z0_mm")])
    views = [v for v in content["views"] if v["camera"] == "cam1"]
    pose = min(views, key=lambda v: float(np.linalg.norm(np.array(v["cam_from_target"]["translation_mm"]) - place)))
    seen = next(v.camera for v in replicate.views if v.file == pose["name"])
    found = Rotation.from_rotvec(pose["cam_from_target"]["rotation_vector_rad"]).as_matrix()
    world = replicate.cameras[0]
    # a board looks alike after half a turn: the corner that it is counted from follows the image
    half = [np.eye(3), np.diag([-1.0, -1.0, 1.0])]
    turned = max(half, key=lambda h: float(np.trace(found.T @ seen.R @ h)))
    R, t = seen.R @ turned, seen.t
    return Frame(R.T @ world.R, R.T @ (world.t - t))


def _covariance(data: Dataset) -> tuple[Array, Array]:
    """(n, m, m) total and own covariance of points."""
    total = np.ma.filled(data["covariance"][:].astype(float), np.nan)
    if "packed" in data["covariance"].ncattrs():
        m = int((np.sqrt(8 * total.shape[-1] + 1) - 1) / 2)
        whole = np.zeros((*total.shape[:-1], m, m))
        rows, cols = np.triu_indices(m)
        whole[..., rows, cols] = whole[..., cols, rows] = total
        total = whole
    m = total.shape[-1]
    F = np.ma.filled(data["common_factor"][:].astype(float), np.nan)
    return total.reshape(-1, m, m), (total - F @ np.swapaxes(F, -1, -2)).reshape(-1, m, m)


def _roots(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))


def _values(data: Dataset, names: tuple[str, ...]) -> Array:
    return np.stack([np.ma.filled(data[name][:].astype(float), np.nan).ravel() for name in names], axis=-1)


def _positions(tally: Tally, data: Dataset, true: Array) -> None:
    error = _values(data, ("x_mm", "y_mm", "z_mm")) - true
    total, own = (_roots(c) for c in _covariance(data))
    for k, axis in enumerate("XYZ"):
        tally.add(SHAPE, axis, error[:, k], total[:, k])
        tally.add(f"{OFF}: {SHAPE}", axis, error[:, k], own[:, k])


def _motion(tally: Tally, name: str, data: Dataset, true: Array) -> None:
    error = _values(data, ("u_mm", "v_mm", "w_mm")) - true
    total, own = (_roots(c)[:, 3:] for c in _covariance(data))
    for k, axis in enumerate("uvw"):
        tally.add(name, axis, error[:, k], total[:, k])
        tally.add(f"{OFF}: {name}", axis, error[:, k], own[:, k])


@dataclass(frozen=True)
class Step:
    """Of one step: errors (n, 3) of u, v, w, their variances that are new in it and that are the reference's, and F."""

    error: Array
    new: Array
    frozen: Array
    factor: dict[str, Array]


def _step(data: Dataset, true: Array) -> Step | None:
    """A step's part of the difference of two; None where the file does not tell the reference's noise apart."""
    if "reference_covariance" not in data.variables:
        return None
    _, own = _covariance(data)
    frozen = np.ma.filled(data["reference_covariance"][:].astype(float), np.nan)
    at = [data["reference_covariance"].components.split().index(name) for name in ("uu", "vv", "ww")]
    frozen = frozen.reshape(len(own), -1)[:, at]
    new = np.diagonal(own, axis1=-2, axis2=-1)[:, 3:] - frozen
    F = np.ma.filled(data["common_factor"][:].astype(float), np.nan).reshape(len(own), 6, -1)[:, 3:]
    causes = [str(name).strip() for name in data["cause"][:]]  # its _Encoding makes strings of the characters
    factor = {name: F[..., [c == name for c in causes]] for name in set(causes)}
    return Step(_values(data, ("u_mm", "v_mm", "w_mm")) - true, new, frozen, factor)


def _common(steps: Sequence[Step], weights: Sequence[float]) -> Array:
    """(n, 3) variance of a weighted sum of steps from the common factor; a file leaves small columns of a cause out."""
    variance = np.zeros_like(steps[0].new)
    for cause in set().union(*(step.factor for step in steps)):
        parts = [step.factor.get(cause, np.zeros((*variance.shape, 0))) for step in steps]
        width = max(part.shape[-1] for part in parts)
        wide = [np.pad(part, ((0, 0), (0, 0), (0, width - part.shape[-1]))) for part in parts]
        variance += (sum(w * part for w, part in zip(weights, wide, strict=True)) ** 2).sum(axis=-1)
    return variance


def _difference(tally: Tally, name: str, first: Step, step: Step) -> None:
    """The displacement of a step less that of the first: the reference's noise cancels."""
    variance = first.new + step.new + _common((first, step), (-1.0, 1.0))
    for k, axis in enumerate("uvw"):
        tally.add(name, f"difference {axis}", step.error[:, k] - first.error[:, k], np.sqrt(variance[:, k]))


def _mean(tally: Tally, steps: Sequence[Step]) -> None:
    """The mean displacement of all steps, with the reference's noise in all of them alike, and as if it were not."""
    n = len(steps)
    error = np.mean([step.error for step in steps], axis=0)
    new = np.sum([step.new for step in steps], axis=0) / n**2
    common = _common(steps, [1.0 / n] * n)
    frozen = np.mean([np.sqrt(np.maximum(step.frozen, 0.0)) for step in steps], axis=0) ** 2
    white = np.sum([step.frozen for step in steps], axis=0) / n**2
    for k, axis in enumerate("uvw"):
        tally.add(MEAN, axis, error[:, k], np.sqrt(new + frozen + common)[:, k])
        tally.add(WHITE, axis, error[:, k], np.sqrt(new + white + common)[:, k])


def _true_strain(replicate: Replicate, frame: Frame, world: Array, A: Array) -> Array:
    """(n, 3) Green-Lagrange strain exx, eyy, exy in the surface's axes at each point."""
    tangents = frame.way(np.swapaxes(replicate.sheet.tangents(world), 1, 2))
    normal = np.cross(tangents[:, 0], tangents[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # away from camera 1, whose centre lies on the side of negative depth
    centre = frame.point(-replicate.cameras[0].R.T @ replicate.cameras[0].t)
    normal *= np.sign(((frame.point(world) - centre) * normal).sum(axis=1, keepdims=True))
    one = np.array([1.0, 0.0, 0.0]) - normal[:, :1] * normal
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two = np.cross(normal, one)
    in_system = frame.R @ A @ frame.R.T
    E = 0.5 * (in_system.T @ in_system - np.eye(3))
    dots = [(a, b) for a, b in ((one, one), (two, two), (one, two))]
    return np.stack([np.einsum("ni,ij,nj->n", a, E, b) for a, b in dots], axis=-1)


def _strain(tally: Tally, name: str, data: Dataset, true: Array) -> None:
    names = ("exx", "eyy", "exy")
    error, sigma = _values(data, names) - true, _values(data, tuple(f"sigma_{c}" for c in names))
    for k, component in enumerate(names):
        tally.add(name, component, error[:, k], sigma[:, k])


def _ends(px: Array) -> tuple[int, int]:
    ends = np.array(ENDS, float).reshape(2, 2)
    a, b = (int(np.argmin(np.abs(px - end).sum(axis=1))) for end in ends)
    return a, b


def _off(number: Mapping[str, float]) -> float:
    return float(np.sqrt(max(number["sigma"] ** 2 - (number["sigma_calibration"] or 0.0) ** 2, 0.0)))


def _read(tally: Tally, motion: str, quantity: str, number: Mapping[str, Any], true: float) -> None:
    tally.add(motion, quantity, number["value"] - true, number["sigma"])
    tally.add(f"{OFF}: {motion}", quantity, number["value"] - true, _off(number))


def _inside(px: Array) -> Any:
    x0, y0, x1, y1 = INSIDE
    return (px[:, 0] >= x0) & (px[:, 0] <= x1) & (px[:, 1] >= y0) & (px[:, 1] <= y1)


def _area(tally: Tally, motion: str, step: Mapping[str, Any], names: Mapping[str, str], true: Array) -> None:
    area = step["areas"][0]
    if area["missing"] or area["valid"] < area["points"]:
        return
    for k, (name, shown) in enumerate(names.items()):
        v = area["values"][name]
        number = {"value": v["mean"], "sigma": v["mean_sigma"], "sigma_calibration": v["mean_sigma_calibration"]}
        _read(tally, motion, f"mean {shown}", number, float(true[k]))


def _shape_gauges(tally: Tally, run: Run, px: Array, true: Array) -> None:
    step, (a, b) = run.gauges["steps"][0], _ends(px)
    gauge = step["extensometers"][0]
    if not gauge["missing"]:
        _read(tally, SHAPE, "length", gauge["values"]["length0_mm"], float(np.linalg.norm(true[b] - true[a])))
    names = {"x_mm": "X", "y_mm": "Y", "z_mm": "Z"}
    _area(tally, SHAPE, step, names, true[_inside(px)].mean(axis=0))


def _gauges(tally: Tally, name: str, step: Mapping[str, Any], px: Array, true: Array, moved: Array) -> None:
    a, b = _ends(px)
    gauge = step["extensometers"][0]
    if not gauge["missing"]:
        before = float(np.linalg.norm(true[b] - true[a]))
        now = float(np.linalg.norm(true[b] + moved[b] - true[a] - moved[a]))
        _read(tally, name, "length", gauge["values"]["length_mm"], now)
        _read(tally, name, "elongation", gauge["values"]["elongation_mm"], now - before)
    _area(tally, name, step, {"u_mm": "u", "v_mm": "v", "w_mm": "w"}, moved[_inside(px)].mean(axis=0))


def _rigid(
    tally: Tally, name: str, moved: Mapping[str, Any], k: int, frame: Frame, world: Array, A: Array, b: Array
) -> None:
    step = next((s for s in moved["steps"] if s["n"] == k), None)
    if step is None or step["rigid_motion"] is None:
        return
    motion = step["rigid_motion"]
    turn = Rotation.from_matrix(frame.R @ A @ frame.R.T).as_rotvec()
    # about the point that the document names
    centre = (np.array(motion["centre_mm"]) - frame.t) @ frame.R
    shift = frame.way((A - np.eye(3)) @ centre + b)
    for i, axis in enumerate("xyz"):
        _read(tally, name, "rotation", motion["values"][f"rotation_{axis}_rad"], float(turn[i]))
        _read(tally, name, "translation", motion["values"][f"translation_{axis}_mm"], float(shift[i]))
