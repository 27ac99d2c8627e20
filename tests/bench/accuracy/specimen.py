"""The real specimen in tension, as a user measures it: strain, its noise reported and observed, extensometers."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.strain import StrainField, StrainOptions, surface_strain
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from tests.bench.accuracy.experiments import specimen_folder
from tests.bench.accuracy.paper_rig import ROOT
from tests.bench.accuracy.rapid_noise import observed_over_reported, window_slope
from tests.bench.accuracy.table import Row, Section

REGION = (340, 430, 1560, 690)
SUBSET, STEP = 33, 10
WINDOWS = (3, 5, 9, 15)
LAG = 2  # steps: 1 to 4 give the same within a tenth
MICRO = 1e6
NAMES = ("exx", "eyy")
# along the load near both edges and in the middle, and across it
AXIAL = {
    "axial, upper": (400, 460, 1500, 460),
    "axial, middle": (400, 560, 1500, 560),
    "axial, lower": (400, 660, 1500, 660),
}
ACROSS = {
    "across, left": (500, 450, 500, 670),
    "across, middle": (950, 450, 950, 670),
    "across, right": (1400, 450, 1400, 670),
}
CENTRE = (950.0, 560.0)


def _run(*arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "stereorig.server.cli", *arguments], check=True, cwd=ROOT, capture_output=True
    )


def _gauges(folder: str) -> list[dict[str, Any]]:
    """Lay the extensometers and a point by ``stereorig gauge``; its document's steps."""
    out = Path(folder) / "gauges.json"
    gauges = [
        v
        for name, ends in (AXIAL | ACROSS).items()
        for v in ("--extensometer", f"{name.replace(',', '')}={','.join(map(str, ends))}")
    ]
    _run(
        "gauge",
        folder,
        *gauges,
        "--point",
        f"{CENTRE[0]},{CENTRE[1]}",
        "--variable",
        "exx",
        "--variable",
        "eyy",
        "--remove-rigid",
        "--out",
        str(out),
    )
    steps: list[dict[str, Any]] = json.loads(out.read_text())["steps"]
    return steps


def strain(figures: Path) -> Section:
    """Measure every figure of the section."""
    data = specimen_folder()
    with tempfile.TemporaryDirectory() as folder:
        _run(
            "measure",
            "--cam1",
            str(data / "000*_0.tif"),
            "--cam2",
            str(data / "000*_1.tif"),
            "--calibration",
            str(data / "calibration_dice.xml"),
            "--roi",
            ",".join(map(str, REGION)),
            "--out",
            folder,
        )
        steps = json.loads((Path(folder) / "summary.json").read_text())["steps"][1:]
        found = [read_strain(Path(folder) / step["file"]) for step in steps]
        fields = [read_field(Path(folder) / step["file"]) for step in steps]
        read = _gauges(folder)[1:]
    strains = [s for s in found if s is not None]
    rows = []
    for k, step in enumerate(steps, start=1):
        summary = step["strain"]
        rows.append(Row(f"step {k}: points with strain", 100 * summary["points"] / step["valid"], "%"))
        for name in NAMES:
            rows += [
                Row(f"step {k}: {name}, mean over the gauges", summary["mean_microstrain"][name], "ue"),
                Row(
                    f"step {k}: {name}, mean of the patches less that of the gauges",
                    summary["patch"]["difference_mean_microstrain"][name],
                    "ue",
                ),
            ]
    rows += _extensometers(read)
    noise_rows, curve = _noise(fields[0])
    rows += noise_rows
    _plot_maps(figures / "accuracy_strain_specimen.png", fields, strains)
    _plot_noise_and_history(figures / "accuracy_specimen_gauges.png", curve, read)
    return Section(
        "Real specimen: strain and gauges",
        f"`d_specimen`, a bar in tension: `stereorig measure`, {SUBSET} px / {STEP} px, Green-Lagrange strain over 9 points, "
        "then `stereorig gauge` on its results. Noise is reported by the covariances, and observed in the field itself: fourth "
        f"differences over {LAG} steps, which the deformation does not reach.",
        rows,
        [
            ("accuracy_strain_specimen.png", "Strain of the real specimen"),
            (
                "accuracy_specimen_gauges.png",
                "Noise of its strain against the gauge's width, and extensometers over the steps",
            ),
        ],
        [
            "The three pairs are one at rest and two under load: there are no two frames of the same state, whose strain would "
            "be zero. The noise is therefore observed in what changes from point to point in the first step; errors that neighbours "
            "have in common are not in it.",
            "The covariances report a quarter more noise than is observed: without a noise model (`--noise`) the residuals stand for it, and on "
            "real pictures they also hold what differs between the pictures (blur, light) and does not scatter from point to point. What "
            "is reported is on the safe side.",
            "Strain of gauge and patch come from the same pictures by different ways; they agree in the mean where the strain is "
            "even over a gauge. The specimen's true strain is not known.",
        ],
    )


def _extensometers(read: Sequence[dict[str, Any]]) -> list[Row]:
    rows = []
    for k, step in enumerate(read, start=1):
        strain = {e["name"]: e["values"]["strain"] for e in step["extensometers"]}
        for name in (*AXIAL, *ACROSS):
            value = strain[name.replace(",", "")]
            rows += [Row(f"step {k}: extensometer {name}", MICRO * value["value"], "ue")]
        for kind in (AXIAL, ACROSS):
            sigma = np.mean([strain[n.replace(",", "")]["sigma"] for n in kind])
            rows.append(Row(f"step {k}: its sigma, {next(iter(kind)).split(',')[0]}", MICRO * float(sigma), "ue"))
        turn = [step["rigid_motion"]["values"][f"rotation_{axis}_rad"]["value"] for axis in "xyz"]
        rows.append(Row(f"step {k}: rigid rotation taken out", 1e3 * float(np.linalg.norm(turn)), "mrad"))
        along, over = (np.mean([strain[n.replace(",", "")]["value"] for n in kind]) for kind in (AXIAL, ACROSS))
        rows.append(Row(f"step {k}: minus across over axial, means of three", float(-over / along), ""))
    return rows


def _noise(field: Field) -> tuple[list[Row], dict[int, tuple[float, Float, Float]]]:
    """Noise of displacements, and of strain for several windows: reported, and observed."""
    shared = SharedPixels.of(field, SUBSET)
    rows, curve = [], {}
    assert field.uvw_mm is not None
    for k, name in enumerate("uvw"):
        sigma = field.sigma_mm[..., 3 + k]
        reported = 1e3 * float(np.sqrt(np.nanmean(sigma**2)))
        ratio = observed_over_reported(field.uvw_mm[..., k], sigma, np.ones((1, 1)), shared, STEP, LAG)
        rows += [
            Row(f"noise of {name}, reported", reported, "um"),
            Row(f"noise of {name}, observed", ratio * reported, "um"),
        ]
    for window in WINDOWS:
        strain = surface_strain(field, StrainOptions(window=window), subset_px=SUBSET)
        whole = slice(window // 2, -(window // 2))
        reported, seen = np.zeros(2), np.zeros(2)
        for k in range(2):
            value, sigma = strain.strain[whole, whole, k], strain.sigma[whole, whole, k]
            reported[k] = MICRO * float(np.sqrt(np.nanmean(sigma**2)))
            seen[k] = reported[k] * observed_over_reported(value, sigma, window_slope(window, k), shared, STEP, LAG)
        curve[window] = (strain.gauge_mm, reported, seen)
        for k, name in enumerate(NAMES):
            where = f"noise floor of {name}, {window} points ({strain.gauge_mm:.1f} mm)"
            rows += [Row(f"{where}, reported", reported[k], "ue"), Row(f"{where}, observed", seen[k], "ue")]
    return rows, curve


def _plot_maps(path: Path, fields: Sequence[Field], strains: Sequence[StrainField]) -> None:
    fig, axes = plt.subplots(2 * len(strains), 1, figsize=(9, 4.4 * len(strains)), layout="constrained")
    for k, (field, strain) in enumerate(zip(fields, strains, strict=True)):
        extent = (field.x_px[0, 0], field.x_px[0, -1], field.y_px[-1, 0], field.y_px[0, 0])
        for j, name in enumerate(NAMES):
            ax = axes[2 * k + j]
            mesh = ax.imshow(MICRO * strain.strain[..., j], aspect="equal", extent=extent)
            ax.set_title(f"step {k + 1}: {name}, gauge of {strain.gauge_mm:.2g} mm", loc="left", fontsize=9)
            ax.tick_params(labelsize=7)
            fig.colorbar(mesh, ax=ax, label="microstrain")
    axes[-1].set_xlabel("x, px")
    fig.savefig(path, dpi=100)
    plt.close(fig)


def _plot_noise_and_history(
    path: Path, curve: dict[int, tuple[float, Float, Float]], read: Sequence[dict[str, Any]]
) -> None:
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.0), layout="constrained")
    gauge = np.array([c[0] for c in curve.values()])
    for k, (name, colour) in enumerate(zip(NAMES, ("#2060a0", "#c04020"), strict=True)):
        axes[0].loglog(gauge, [c[1][k] for c in curve.values()], "-", color=colour, lw=0.9, label=f"{name}, reported")
        axes[0].loglog(gauge, [c[2][k] for c in curve.values()], "o", color=colour, label=f"{name}, observed")
    for window, (x, _, seen) in curve.items():
        axes[0].annotate(
            f"{window} points", (x, seen[1]), xytext=(-4, -12), textcoords="offset points", fontsize=7, ha="right"
        )
    axes[0].set(xlabel="width of the gauge / mm", ylabel="sd / microstrain", title="Noise of strain, first step")
    axes[0].set_xlim(2.0, 13.0)
    axes[0].set_xticks([2, 3, 5, 10], ["2", "3", "5", "10"])
    axes[0].set_yticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
    axes[0].minorticks_off()
    axes[0].legend(fontsize=8)
    number = np.arange(len(read) + 1)
    for names, style in ((AXIAL, "o-"), (ACROSS, "s--")):
        for name in names:
            values = [
                next(e for e in s["extensometers"] if e["name"] == name.replace(",", ""))["values"]["strain"]
                for s in read
            ]
            axes[1].plot(number, [0.0, *(100 * v["value"] for v in values)], style, ms=4, lw=0.9, label=name)
    axes[1].axhline(0.0, color="0.7", lw=0.6)
    axes[1].set(
        xlabel="step",
        ylabel="engineering strain / %",
        title="Virtual extensometers (their sigma is below a line's width)",
    )
    axes[1].set_xticks(number)
    axes[1].legend(fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)


SECTIONS: dict[str, Callable[[Path], Section]] = {"strain-specimen": strain}
