"""``stereorig evaluate``: run an installed evaluation over measured results, or list what is installed."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from stereorig.core.errors import InputError
from stereorig.core.progress import no_progress
from stereorig.server.cli.evidence.batch import rows_of, run_batch
from stereorig.server.evaluations.door import (
    Described,
    Evaluated,
    Evaluation,
    described,
    document_of,
    evaluate,
    evaluation,
)
from stereorig.server.exports.vtu import write_vtu
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.results.folder import first_results, number_of
from stereorig.server.formats.results.summary import to_json
from stereorig.server.results.reader import FileVariable
from stereorig.server.results.steps import ExportSource, read_step

_SHOWN = 8  # numbers of a list


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Run an evaluation over the results of a measurement: numbers and a verdict, from this program or from an "
        "installed package. Without a name, list the evaluations with their settings. Ends with 1 if the evaluation "
        "does not accept the results."
    )
    add = parser.add_argument
    add("name", metavar="NAME", nargs="?", help="evaluation, as conformity; left out: list those that are installed")
    text = "results of stereorig measure, or of an analysis; a CSV with a column folder: those of several, a row each"
    add("folder", metavar="FOLDER", nargs="?", type=Path, help=text)
    add("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="a setting; VALUE may be JSON")
    add("--out", type=Path, metavar="DIR", help="folder for NAME.json, and NAME.vtu if it adds variables to the points")
    add("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List, or evaluate, print, write."""
    if args.name is None:
        found = described()
        print(to_json([asdict(one) for one in found]).decode() if args.json else "\n".join(_listed(found)))
        return 0
    if args.folder is None:
        raise InputError("No folder of results is given.", code="wrong_usage", remedy="See stereorig evaluate --help.")
    made = evaluation(args.name)
    settings = dict(_setting(text) for text in args.settings)
    if args.folder.suffix.lower() == ".csv":
        return _several(made, args, settings)
    files = results_of(args.folder)
    outcome = evaluate(made, files, settings, no_progress)
    document = document_of(outcome)
    if args.out is not None:
        _write(args.out, args.name, outcome)
        if outcome.variables:
            write_points(args.out / f"{args.name}.vtu", outcome, files)
    print(to_json(document).decode() if args.json else "\n".join([made.title, *_lines(document)]))
    return 1 if document.get("accepted") is False else 0


def results_of(folder: Path) -> list[Path]:
    """Return the result files of a folder that a user named."""
    return first_results(folder, (folder, folder / "exports" / "measure"))


def _several(made: Evaluation, args: argparse.Namespace, settings: dict[str, Any]) -> int:
    """Evaluate each row of a table, write a folder for each, and print what there is over all."""
    found, refused, over = run_batch(made, rows_of(args.folder), settings, args.folder.parent, results_of, _setting)
    if args.out is not None:
        for name, outcome in found.items():
            _write(args.out / name, args.name, outcome)
        if over is not None:
            _write(args.out, f"{args.name}_all", over)
    documents = {name: document_of(outcome) for name, outcome in found.items()}
    of_all = {} if over is None else document_of(over)
    failures = {name: {"code": one.code, "cause": one.cause, "remedy": one.remedy} for name, one in refused.items()}
    shown: dict[str, object] = {"all": of_all, "refused": failures}
    lines = [made.title, *_lines(shown)]
    print(to_json({**shown, "each": documents}).decode() if args.json else "\n".join(lines))
    return 1 if refused or any(one.get("accepted") is False for one in documents.values()) else 0


def _write(out: Path, name: str, outcome: Evaluated) -> None:
    make_folder(out)
    write_bytes(out / f"{name}.json", to_json(document_of(outcome)))
    for ending, text in outcome.files.items():
        write_bytes(out / f"{name}{ending}", text.encode())


def write_points(path: Path, outcome: Evaluated, files: list[Path]) -> None:
    """Write the step that was evaluated with the variables that the evaluation adds, as VTU."""
    step = read_step(next(file for file in files if number_of(file) == outcome.step))
    added = {
        name: FileVariable(one.values, one.units, one.long_name, ("row", "col"))
        for name, one in outcome.variables.items()
    }
    write_vtu(path, replace(step, variables={**step.variables, **added}), ExportSource(files, path.stem))


def _setting(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals:
        raise InputError(
            f"--set {text[:60]!r} has no '='.", code="wrong_usage", remedy="Write --set KEY=VALUE, as --set upper=0.1."
        )
    try:
        return key, json.loads(value)
    except ValueError:
        return key, value


def _listed(found: Iterable[Described]) -> list[str]:
    lines = []
    for one in found:
        lines.append(f"{one.name}: {one.problem or one.title} ({one.package})")
        required = one.settings.get("required", [])
        for name, schema in one.settings.get("properties", {}).items():
            default = "required" if name in required else json.dumps(schema.get("default"))
            lines.append(f"  {name} ({default}): {schema.get('description', '')}")
    return lines or ["No evaluation is installed."]


def _lines(document: dict[str, object], indent: str = "  ") -> list[str]:
    lines = []
    for name, value in document.items():
        if isinstance(value, dict):
            lines += [f"{indent}{name}:", *_lines(value, indent + "  ")]
        elif isinstance(value, list) and len(value) > _SHOWN:
            lines.append(f"{indent}{name}: {len(value)} values, see --json")
        else:
            lines.append(f"{indent}{name}: {format(value, '.6g') if isinstance(value, float) else value}")
    return lines
