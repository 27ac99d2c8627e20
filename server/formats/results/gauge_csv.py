"""Readings of gauges as a table: one number a row, so that any program can filter and plot it."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from typing import Any

COLUMNS = (
    "step",
    "label",
    "load_n",
    "gauge",
    "kind",
    "x_px",
    "y_px",
    "distance_px",
    "quantity",
    "value",
    "sigma",
    "units",
    "missing",
)
_OF_AREA = ("mean", "sd", "min", "max", "rms", "count")
NO_VALUE = "no value"


def gauges_csv(document: dict[str, Any]) -> bytes:
    """Return the readings as CSV, settings and inputs in comment lines (#) above the header.

    Missing numbers are empty, with the reason in the last column.

    Parameters
    ----------
    document
        Of :func:`server.results.gauges.readings.read_gauges`.
    """
    text = io.StringIO(newline="")
    for name in (
        "software_version",
        "stale_reasons",
        "frame",
        "subset_px",
        "smoothing_window",
        "settings",
        "inputs_sha256",
        "alignment",
    ):
        text.write(f"# {name}: {json.dumps(document[name], ensure_ascii=False, sort_keys=True)}\n")
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for step in document["steps"]:
        head = {"step": step["n"], "label": step["label"], "load_n": _cell(step["load_n"])}
        for row in rows(step):
            if row.get("value") is None:  # the place is there, but this variable has nothing there
                row["missing"] = row.get("missing") or NO_VALUE
            writer.writerow({**head, **{k: _cell(v) for k, v in row.items()}})
    return text.getvalue().encode()


def rows(step: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the readings of one step, one number each."""
    if "problem" in step:
        yield {"kind": "step", "missing": step["problem"]["cause"]}
        return
    if "rigid_motion" in step:
        for quantity, number in step["rigid_motion"]["values"].items():
            yield {"gauge": "rigid motion", "kind": "rigid_motion", "quantity": quantity, **number}
    for point in step["points"]:
        x, y = point["xy_px"]
        for quantity, number in point["values"].items():
            yield {
                "gauge": point["name"],
                "kind": "point",
                "x_px": x,
                "y_px": y,
                "quantity": quantity,
                **number,
                "missing": point["missing"],
            }
    for gauge in step["extensometers"]:
        for quantity, number in gauge["values"].items():
            yield {
                "gauge": gauge["name"],
                "kind": "extensometer",
                "quantity": quantity,
                **number,
                "missing": gauge["missing"],
            }
    for area in step["areas"]:
        for quantity, v in area["values"].items():
            for part in _OF_AREA:
                yield {
                    "gauge": area["name"],
                    "kind": "area",
                    "quantity": f"{quantity}:{part}",
                    "value": v[part],
                    "sigma": v["mean_sigma"] if part == "mean" else None,
                    "units": "1" if part == "count" else v["units"],
                    "missing": area["missing"],
                }
    for line in step["lines"]:
        for quantity, v in line["values"].items():
            for k, (x, y, at) in enumerate(zip(line["x_px"], line["y_px"], line["distance_px"], strict=True)):
                yield {
                    "gauge": line["name"],
                    "kind": "line",
                    "x_px": x,
                    "y_px": y,
                    "distance_px": at,
                    "quantity": quantity,
                    "value": v["value"][k],
                    "sigma": v["sigma"][k],
                    "units": v["units"],
                    "missing": line["missing"][k],
                }


def _cell(value: Any) -> Any:
    return "" if value is None else repr(value) if isinstance(value, float) else value
