"""The resolution study as an evaluation: static steps in, noise and spatial resolution out."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.window import steps_of
from stereorig.core.progress import Progress
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.evaluations.cards import CardNumber, MarkFound, number_found, number_missing
from stereorig.server.evaluations.door import Evaluated, Results
from stereorig.server.evaluations.histories import shared_pixels
from stereorig.server.evaluations.resolution.document import (
    Reported,
    ResolutionFound,
    SettingFound,
    SubsetFound,
    page_of,
    table_of,
)
from stereorig.server.evaluations.resolution.noise import Scatter, scatter, thinned
from stereorig.server.evaluations.resolution.origin import Origin
from stereorig.server.evaluations.resolution.reporting import reporting
from stereorig.server.evaluations.resolution.settings import ResolutionSettings
from stereorig.server.evaluations.resolution.steepest import bias_of, moment_px2, steepest, whole_windows
from stereorig.server.evaluations.resolution.transfer import Filter, l10_px, patch_filter, slope_filter

_STATIC = re.compile(r"\s*static\b", re.IGNORECASE)
_STRAINS = ("exx", "eyy", "exy")
_BEYOND = 4.0  # standard deviations of a bias that noise does not exceed
_UNLIKE = 1.5  # factor between measured and reported noise that is marked


@dataclass(frozen=True, eq=False)
class _Subset:
    """What was measured with a subset: the static steps, and the step whose steepest place is looked for."""

    px: int
    spacing_px: float
    mm_per_px: float
    static: list[Field]
    loaded: Field | None

    def thinned(self, every: int) -> _Subset:
        """Return the same at every so many of the rows and columns."""
        loaded = None if self.loaded is None else thinned(self.loaded, every)
        static = [thinned(field, every) for field in self.static]
        return replace(self, spacing_px=every * self.spacing_px, static=static, loaded=loaded)


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
            ``static_missing``, ``step_missing``, ``settings_missing``, ``no_displacement``.
        MeasurementError
            ``too_few_points`` if the region holds too few subsets beside each other.
        """
        steps, loaded = _static(results, asked), _loaded(results, asked)
        fields = [results.field(step) for step in steps]
        subset = int(shared_pixels(results.file(steps[0]), fields[0]).subset_px)
        spacing = steps_of(np.stack([fields[0].x_px, fields[0].y_px], axis=-1))[0]
        scale = _mm_per_px(fields[0])
        own = _Subset(subset, spacing, scale, fields, None if loaded is None else results.field(loaded))
        others = [one for one in dict.fromkeys(asked.subsets_px) if one != subset]
        marks: list[MarkFound] = []
        subsets, studied = [_displacement(own)], []
        for k, one in enumerate((own, *_anew(results, steps, loaded, own, others, marks))):
            progress("resolution", k, 1 + len(others))
            subsets += [_displacement(one)] if k else []
            studied += [
                _strain(one, every, window) for every in asked.spacing_multiples for window in asked.strain_windows
            ]
        chosen = _chosen(studied, asked)
        short = asked.strain_noise is not None and (chosen is None or not _quiet(chosen, asked.strain_noise))
        wanted = asked.smallest_feature_mm is not None or asked.strain_noise is not None
        met = chosen is not None and not short
        card = ResolutionFound(
            verdict="not asked" if not wanted else "met" if met else "not met",
            accepted=met or not wanted,
            subset_px=subset,
            patch=subsets[0].patch,
            static_steps=steps,
            mm_per_px=scale,
            l10_px=subsets[0].l10_px,
            l10_mm=subsets[0].l10_mm,
            displacement=subsets[0].numbers,
            steepest_step=loaded,
            subsets=subsets,
            settings=studied,
            chosen=chosen,
            marks=[*_marks(subsets[0].numbers, steps), *marks],
            reporting=_reported(Origin(results, steps[0]), fields[0], subsets, studied, chosen, scale),
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


def _loaded(results: Results, asked: ResolutionSettings) -> int | None:
    """Return the step whose steepest place is looked for."""
    moved = [step for step in results.steps if results.head(step).kind == "displacement"]
    if asked.steepest_step is not None:
        results.file(asked.steepest_step)
        if asked.steepest_step not in moved:
            raise InputError(
                f"Step {asked.steepest_step} has no displacements.",
                code="no_displacement",
                remedy="Name a loaded step as steepest_step, or leave it out.",
            )
        return asked.steepest_step
    static = set(asked.static_steps or [step for step in moved if _STATIC.match(results.head(step).label)])
    return max((step for step in moved if step not in static), default=None)


def _reported(
    origin: Origin,
    points: Field,
    subsets: list[SubsetFound],
    studied: list[SettingFound],
    chosen: SettingFound | None,
    scale: float,
) -> list[Reported]:
    """Return the reporting tables of the chosen setting; without one, of the measured subset's first."""
    setting = chosen if chosen is not None else next(iter(studied), None)
    px = subsets[0].subset_px if setting is None else setting.subset_px
    return reporting(origin, points, next(one for one in subsets if one.subset_px == px), setting, scale)


def _anew(
    results: Results, steps: list[int], loaded: int | None, like: _Subset, others: list[int], marks: list[MarkFound]
) -> Iterator[_Subset]:
    """Measure the steps with each other subset, or mark why that cannot be."""
    wanted = [*steps, *(() if loaded is None else (loaded,))]
    try:
        for subset in others:
            if subset == others[0]:
                # the matching is slow to load, and not every study needs it
                from stereorig.server.evaluations.resolution.anew import MeasuredAnew

                anew = MeasuredAnew(Origin(results, steps[0]), like.static[0], like.spacing_px)
            fields = anew.fields(wanted, subset)
            yield replace(
                like, px=subset, static=fields[: len(steps)], loaded=None if loaded is None else fields[len(steps)]
            )
    except InputError as error:
        if error.code != "images_missing":
            raise
        text = f"{error.cause} The measured subset alone is studied."
        marks.append(MarkFound(code=error.code, text=text, steps=wanted))


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


def _displacement(of: _Subset) -> SubsetFound:
    filters = _of_displacement(of.static[0], of.px)
    resolved, width = l10_px(filters), _width(filters)
    # the second derivative is taken over as much of the surface as the subset sees
    window, moment = 2 * max(2, round(0.5 * of.px / of.spacing_px)) + 1, moment_px2(filters)
    numbers: dict[str, CardNumber] = {}
    steepest_px: dict[str, tuple[float, float]] = {}
    for k, name in enumerate("uvw"):
        values = [_motion(field)[..., k] for field in of.static]
        sigma = [np.sqrt(field.covariance[..., 3 + k, 3 + k]) for field in of.static]
        found = scatter(values, sigma, width, of.spacing_px)
        if found is None:
            raise MeasurementError(
                f"The region holds too few subsets of {of.px} px beside each other for a scatter.",
                code="too_few_points",
                remedy="Measure a larger region, or with a smaller subset.",
            )
        numbers |= _numbers(name, found, "mm", resolved * of.mm_per_px, "mm^2", 1)
        bent = None if of.loaded is None else bias_of(_motion(of.loaded)[..., k], of.spacing_px, window, moment, moment)
        still = [bias_of(one, of.spacing_px, window, moment, moment) for one in values]
        if any(_order(field) == 2 for field in of.static):
            why = "patch_quadratic: its bias goes with the fourth derivative, which noise hides."
            numbers[f"bias_{name}"] = number_missing(f"bias_{name}", "mm", why)
            continue
        numbers[f"bias_{name}"], place = _bias(f"bias_{name}", "mm", bent, still, width, of)
        steepest_px |= {} if place is None else {f"bias_{name}": place}
    return SubsetFound(
        subset_px=of.px,
        patch="quadratic" if _order(of.static[0]) == 2 else "plane",
        l10_px=resolved,
        l10_mm=resolved * of.mm_per_px,
        numbers=numbers,
        steepest_px=steepest_px,
    )


def _strain(measured: _Subset, every: int, window: int) -> SettingFound:
    of = measured.thinned(every)
    point = _of_displacement(of.static[0], of.px)
    # a strain may vary along its own direction or across it, where the window takes a mean
    slope, mean = (
        [*point, last(of.spacing_px)] for last in (partial(slope_filter, window), partial(patch_filter, window, 1))
    )
    gauge, resolved = _width(slope), max(l10_px(way) for way in (slope, mean))
    # a region narrower than the window has no strain at all
    fields = of.static if of.loaded is None else [*of.static, of.loaded]
    fits = all(min(field.shape) >= window for field in fields)
    strains = [surface_strain(one, StrainOptions(window=window), subset_px=of.px) for one in fields] if fits else []
    still, whole = strains[: len(of.static)], [whole_windows(one.valid, window) for one in fields if fits]
    moments = moment_px2(slope), moment_px2(mean)
    along, down = moments if _columns_are_x(of.static[0]) else moments[::-1]
    numbers: dict[str, CardNumber] = {}
    steepest_px: dict[str, tuple[float, float]] = {}
    # a shear is half of two slopes, one along each direction
    ways = (along, down), (down, along), (0.5 * sum(moments), 0.5 * sum(moments))
    for k, name in enumerate(_STRAINS):
        every_value = [np.where(one.valid, one.strain[..., k], np.nan) for one in strains]
        values = every_value[: len(still)]
        found = scatter(values, [one.sigma[..., k] for one in still], gauge, of.spacing_px, about_zero=True)
        numbers |= _numbers(name, found, "1", resolved * of.mm_per_px, "mm^2", 2)
        each = [
            bias_of(np.where(inside, one, np.nan), of.spacing_px, window, *ways[k])
            for one, inside in zip(every_value, whole, strict=True)
        ]
        bent = each[-1] if of.loaded is not None and each else None
        key = f"bias_{name}"
        numbers[key], place = _bias(key, "1", bent, each[: len(still)], gauge, of)
        steepest_px |= {} if place is None else {key: place}
    return SettingFound(
        subset_px=of.px,
        spacing_px=of.spacing_px,
        strain_window=window,
        gauge_px=gauge,
        l10_px=resolved,
        l10_mm=resolved * of.mm_per_px,
        numbers=numbers,
        steepest_px=steepest_px,
    )


def _columns_are_x(field: Field) -> bool:
    """Return True if the surface's x, along which exx is, runs along the image's rows rather than down its columns."""
    across, down = (float(np.nanmedian(np.abs(np.diff(field.xyz_mm[..., 0], axis=axis)))) for axis in (1, 0))
    return across >= down


def _bias(
    key: str, units: str, bent: Float | None, still: Sequence[Float], width_px: float, of: _Subset
) -> tuple[CardNumber, tuple[float, float] | None]:
    """Return the largest bias with the noise that static steps show of it, and its place; missing without either."""
    if bent is None or of.loaded is None:
        return number_missing(key, units, "no_loaded_step: every step is static."), None
    found = steepest(bent)
    noise = scatter(still, [np.zeros_like(one) for one in still], width_px, of.spacing_px, about_zero=True)
    if found is None or noise is None:
        return number_missing(key, units, "region_small: no window is whole, or too few are."), None
    # the largest of many places is beyond two or three deviations of noise alone
    doubts = ("below_noise",) if abs(found.bias) < _BEYOND * noise.sd else ()
    place = float(of.loaded.x_px[found.row, found.col]), float(of.loaded.y_px[found.row, found.col])
    return number_found(key, found.bias, units, {"noise": noise.sd}, doubts), place


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
