"""The resolution study as an evaluation: static steps in, noise and spatial resolution out."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.window import steps_of
from stereorig.core.progress import Progress
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.evaluations.cards import CardNumber, MarkFound, number_found, number_missing
from stereorig.server.evaluations.door import Evaluated, Results
from stereorig.server.evaluations.histories import shared_pixels
from stereorig.server.evaluations.resolution.document import ResolutionFound, SettingFound, page_of, table_of
from stereorig.server.evaluations.resolution.noise import Scatter, scatter, thinned
from stereorig.server.evaluations.resolution.settings import ResolutionSettings
from stereorig.server.evaluations.resolution.transfer import Filter, l10_px, patch_filter, slope_filter

_STATIC = re.compile(r"\s*static\b", re.IGNORECASE)
_STRAINS = ("exx", "eyy", "exy")
_UNLIKE = 1.5  # factor between measured and reported noise that is marked


class ResolutionStudy:
    """The evaluation."""

    name = "resolution"
    title = "Noise and spatial resolution"
    settings = ResolutionSettings
    document = ResolutionFound
    needs: frozenset[str] = frozenset()

    def run(self, results: Results, asked: ResolutionSettings, progress: Progress) -> Evaluated:
        """Work out the study.

        Raises
        ------
        InputError
            ``static_missing``, ``step_missing``, ``settings_missing``.
        MeasurementError
            ``too_few_points`` if the region holds too few subsets beside each other.
        """
        steps = _static(results, asked)
        fields = [results.field(step) for step in steps]
        subset = int(shared_pixels(results.file(steps[0]), fields[0]).subset_px)
        spacing = steps_of(np.stack([fields[0].x_px, fields[0].y_px], axis=-1))[0]
        filters = _of_displacement(fields[0], subset)
        scale, own = _mm_per_px(fields[0]), l10_px(filters)
        width = _width(filters)
        displacement: dict[str, CardNumber] = {}
        for k, name in enumerate("uvw"):
            found = scatter(
                [_motion(field)[..., k] for field in fields],
                [np.sqrt(field.covariance[..., 3 + k, 3 + k]) for field in fields],
                width,
                spacing,
            )
            if found is None:
                raise MeasurementError(
                    f"The region holds too few subsets of {subset} px beside each other for a scatter.",
                    code="too_few_points",
                    remedy="Measure a larger region, or with a smaller subset.",
                )
            displacement |= _numbers(name, found, "mm", own * scale, "mm^2", 1)
        studied: list[SettingFound] = []
        for k, every in enumerate(asked.spacing_multiples):
            progress("resolution", k, len(asked.spacing_multiples))
            thin = [thinned(field, every) for field in fields]
            studied += [_strain(thin, subset, every * spacing, window, scale) for window in asked.strain_windows]
        chosen = _chosen(studied, asked)
        short = asked.strain_noise is not None and (chosen is None or not _quiet(chosen, asked.strain_noise))
        wanted = asked.smallest_feature_mm is not None or asked.strain_noise is not None
        met = chosen is not None and not short
        card = ResolutionFound(
            verdict="not asked" if not wanted else "met" if met else "not met",
            accepted=met or not wanted,
            subset_px=subset,
            patch="quadratic" if _order(fields[0]) == 2 else "plane",
            static_steps=steps,
            mm_per_px=scale,
            l10_px=own,
            l10_mm=own * scale,
            displacement=displacement,
            settings=studied,
            chosen=chosen,
            marks=_marks(displacement, steps),
        )
        return Evaluated(card, steps[-1], files={".csv": table_of(card), ".html": page_of(self.title, card)})


def _static(results: Results, asked: ResolutionSettings) -> list[int]:
    moved = [step for step in results.steps if results.head(step).kind == "displacement"]
    if asked.static_steps is None:
        found = [step for step in moved if _STATIC.match(results.head(step).label)]
    else:
        for step in asked.static_steps:
            results.file(step)
        found = sorted(set(asked.static_steps) & set(moved))
    if not found:
        raise InputError(
            "No step with displacements is known to be static.",
            code="static_missing",
            remedy="Take a few pairs before loading, label them `static` and measure them, or name static_steps.",
        )
    return found


def _motion(field: Field) -> np.ndarray:
    assert field.uvw_mm is not None
    return field.uvw_mm


def _order(field: Field) -> int:
    """Return the order of the patch that most points were measured with."""
    if field.patch_degree is not None:
        return 2 if np.median(field.patch_degree[field.valid]) > 1.5 else 1
    return 2 if field.patch is not None and field.patch.patch == "quadratic" else 1


def _of_displacement(field: Field, subset: int) -> list[Filter]:
    filters = [patch_filter(subset, _order(field))]
    if field.smoothing is not None:
        filters.append(patch_filter(field.smoothing.window, field.smoothing.order, field.smoothing.spacing_px))
    return filters


def _width(filters: list[Filter]) -> float:
    """Return the width over which a value depends on pixels."""
    return sum((len(one.weights) - 1) * one.step_px for one in filters) + 1.0


def _mm_per_px(field: Field) -> float:
    """Return the size of a pixel on the surface, the longer of both sides."""
    across, down = steps_of(np.stack([field.x_px, field.y_px], axis=-1))
    lengths = [np.linalg.norm(np.diff(field.xyz_mm, axis=axis), axis=-1) for axis in (1, 0)]
    if not all(np.isfinite(one).any() for one in lengths):
        raise MeasurementError(
            "No two neighbouring points were measured.",
            code="too_few_points",
            remedy="Look at the points' status, or measure a larger region.",
        )
    return max(float(np.nanmedian(one)) / step for one, step in zip(lengths, (across, down), strict=True))


def _strain(fields: list[Field], subset: int, spacing: float, window: int, scale: float) -> SettingFound:
    point = _of_displacement(fields[0], subset)
    # a strain may vary along its own direction or across it, where the window takes a mean
    ways = [[*point, last] for last in (slope_filter(window, spacing), patch_filter(window, 1, spacing))]
    gauge, resolved = _width(ways[0]), max(l10_px(way) for way in ways)
    # a region narrower than the window has no strain at all
    fits = all(min(field.shape) >= window for field in fields)
    strains = [surface_strain(one, StrainOptions(window=window), subset_px=subset) for one in fields] if fits else []
    numbers: dict[str, CardNumber] = {}
    for k, name in enumerate(_STRAINS):
        values = [np.where(one.valid, one.strain[..., k], np.nan) for one in strains]
        found = scatter(values, [one.sigma[..., k] for one in strains], gauge, spacing, about_zero=True)
        numbers |= _numbers(name, found, "1", resolved * scale, "mm^2", 2)
    return SettingFound(
        spacing_px=spacing,
        strain_window=window,
        gauge_px=gauge,
        l10_px=resolved,
        l10_mm=resolved * scale,
        numbers=numbers,
    )


def _numbers(
    name: str, found: Scatter | None, units: str, l10_mm: float, product: str, power: int
) -> Mapping[str, CardNumber]:
    """Return the measured noise, its ratio to the reported one, and its product with l10 to a power (MEI)."""
    keys = f"noise_{name}", f"ratio_{name}", f"mei_{name}"
    if found is None:
        why = "region_small: it holds too few gauges beside each other."
        each = zip(keys, (units, "1", product), strict=True)
        return {key: number_missing(key, unit, why) for key, unit in each}
    size = l10_mm**power
    ratio = number_missing(keys[1], "1", "nothing_reported: the results state no noise.")
    if found.reported > 0.0:
        ratio = number_found(keys[1], found.sd / found.reported, "1", {"sample": found.u / found.reported}, ())
    return {
        keys[0]: number_found(keys[0], found.sd, units, {"sample": found.u}, ()),
        keys[1]: ratio,
        keys[2]: number_found(keys[2], found.sd * size, product, {"sample": found.u * size}, ()),
    }


def _loudest(one: SettingFound) -> float:
    values = [one.numbers[f"noise_{name}"].value for name in _STRAINS]
    return max((value for value in values if value is not None), default=float("inf"))


def _quiet(one: SettingFound, allowed: float) -> bool:
    return _loudest(one) <= allowed


def _chosen(studied: list[SettingFound], asked: ResolutionSettings) -> SettingFound | None:
    """Return the quietest setting that resolves the feature; of a noise alone, the finest that is quiet enough."""
    known = [one for one in studied if np.isfinite(_loudest(one))]
    if asked.smallest_feature_mm is not None:
        feature = asked.smallest_feature_mm
        return min((one for one in known if one.l10_mm <= feature), key=_loudest, default=None)
    if asked.strain_noise is not None:
        allowed = asked.strain_noise
        return min((one for one in known if _quiet(one, allowed)), key=lambda one: one.l10_mm, default=None)
    return None


def _marks(displacement: Mapping[str, CardNumber], steps: list[int]) -> list[MarkFound]:
    marks = []
    for name in "uvw":
        ratio = displacement[f"ratio_{name}"].value
        if ratio is not None and not 1.0 / _UNLIKE < ratio < _UNLIKE:
            text = f"The scatter of {name} is {ratio:.3g} times what is reported: did something move?"
            marks.append(MarkFound(code=f"noise_differs_{name}", text=text, steps=steps))
    return marks
