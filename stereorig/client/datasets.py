"""Results as data sets of xarray, which is imported at the first request for one."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereorig.core.errors import StateError
from stereorig.server.api.models import GaugesReply

if TYPE_CHECKING:
    import xarray


_AGAINST_REFERENCE = ("elongation_mm", "strain", "true_strain")


def _xarray() -> Any:
    try:
        import xarray
    except ImportError as error:
        raise StateError(
            "A data set is asked for, and xarray is not installed.",
            code="xarray_missing",
            remedy="pip install 'stereorig[xarray]'.",
        ) from error
    return xarray


def stacked(files: Mapping[int, bytes]) -> xarray.Dataset:
    """Return the steps' NetCDF files as one data set with the dimension ``step``; NaN where a step lacks one."""
    xr = _xarray()
    steps = []
    with tempfile.TemporaryDirectory() as folder:
        for n, content in files.items():
            path = Path(folder) / f"{n}.nc"
            path.write_bytes(content)
            steps.append(xr.load_dataset(path, engine="netcdf4").assign_coords(step=n))
    channels = {name for one in steps for name in one.data_vars if str(name).startswith("channel_")}
    steps = [one.set_coords([name for name in channels if name in one]) for one in steps]
    if len(steps) == 1:
        return steps[0]  # type: ignore[no-any-return]
    positions = [name for name in ("x_px", "y_px") if name in steps[-1]]
    varying = [one.drop_vars([*positions, *_of_other_shape(one, steps[-1])], errors="ignore") for one in steps]
    together = xr.concat(varying, dim="step", data_vars="all", coords="minimal", compat="override", join="outer")
    return together.assign_coords({name: steps[-1][name].drop_vars("step") for name in positions})  # type: ignore[no-any-return]


def array_of(files: Mapping[int, bytes], name: str) -> xarray.DataArray:
    """Return a variable of the steps as :func:`stacked` does, with the frame that it is given in."""
    data = stacked(files)
    return data[name].assign_attrs({key: data.attrs[key] for key in ("frame",) if key in data.attrs})


def _of_other_shape(one: Any, last: Any) -> list[str]:
    """Return variables that cannot be stacked: a shape compares two images, where a displacement compares four."""
    sizes = last.sizes
    return [name for name, v in one.variables.items() if any(sizes.get(d, n) != n for d, n in v.sizes.items())]


def extensometers(reply: GaugesReply) -> xarray.Dataset:
    """Return extensometers over the steps: each quantity with its ``sigma_...``, over ``step`` and ``gauge``.

    Load, channels and time are coordinates of the steps, so that ``data.strain.plot(x="force_kn")`` draws one against
    the other.
    """
    xr = _xarray()
    steps = [one for one in reply.steps if one.extensometers]
    names = [gauge.name for gauge in steps[0].extensometers] if steps else []
    quantities = list(dict.fromkeys(q for one in steps for gauge in one.extensometers for q in gauge.values))
    held: dict[str, Any] = {}
    for quantity in quantities:
        numbers = [[gauge.values.get(quantity) for gauge in one.extensometers] for one in steps]
        units = next((n.units for row in numbers for n in row if n is not None), "1")
        for prefix, part in (("", "value"), ("sigma_", "sigma")):
            # quantities that are measured against the reference are zero there, by definition
            at_rest = 0.0 if quantity in _AGAINST_REFERENCE else np.nan
            table = np.array(
                [
                    [at_rest if one.kind == "shape" and not _known(n) else _number(n, part) for n in row]
                    for one, row in zip(steps, numbers, strict=True)
                ],
                dtype=float,
            )
            held[f"{prefix}{quantity}"] = (("step", "gauge"), table, {"units": units})
    data = xr.Dataset(held, coords={"step": [one.n for one in steps], "gauge": names}, attrs={"frame": reply.frame})
    for name, values, units in _of_steps(reply, steps):
        data = data.assign_coords({name: ("step", np.array(values, dtype=float), {"units": units})})
    return data.squeeze("gauge") if len(names) == 1 else data  # type: ignore[no-any-return]


def _of_steps(reply: GaugesReply, steps: list[Any]) -> list[tuple[str, list[float], str]]:
    found = [("load_n", [_or_nan(one.load_n) for one in steps], "N")]
    found += [("time_s", [_or_nan(one.time_s) for one in steps], "s")]
    for name in dict.fromkeys(name for one in steps for name in one.channels):
        channel = [_or_nan(one.channels.get(name)) for one in steps]
        found.append((name, channel, reply.channel_units.get(name, "1")))
    return [(name, values, units) for name, values, units in found if np.isfinite(values).any()]


def _known(number: Any) -> bool:
    return number is not None and number.value is not None


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _number(number: Any, part: str) -> float:
    return _or_nan(None if number is None else getattr(number, part))
