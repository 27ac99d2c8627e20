"""``stereorig certify``: a verification certificate from measured steps and their known values."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.results.summary import to_json
from stereorig.server.results.certificate.findings import finding_lines
from stereorig.server.results.certificate.plan import load_plan

OUTCOME_STATUS = {"pass": 0, "conditional": 4, "fail": 5}
"""Exit status by verdict; 1 to 3 are errors, as of every command."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Judge a measuring system by static pairs, known translations, known lengths, a rotation and a reference "
        "extensometer, as far as a plan names them: noise floor, errors with their uncertainty, class of the virtual "
        "extensometer, verdict with reasons and suspected causes. Writes certificate.json and certificate.html. Ends "
        "with 0 for a pass, 4 for a conditional one, 5 for a fail. With --run the plan is carried out on a running "
        "service: its steps are taken (the stage moves if it can, else a person is asked), measured with "
        "strain, and judged; the certificate is the service's, and its files are written here too."
    )
    add = parser.add_argument
    add(
        "folder",
        metavar="DATA_OR_RESULTS",
        type=Path,
        nargs="?",
        help="a data folder, a test's, an analysis', or an output of stereorig measure --out; not with --run",
    )
    add("plan", metavar="PLAN", type=Path, help="JSON: the known values of each step, and the limits")
    add("--test", metavar="ID", help="which test of a data folder (its only one)")
    add("--analysis", metavar="ID", help="analysis of a test (the newest with results)")
    add("--calibration", metavar="FILE", type=Path, help="the calibration, if it is not in the results' folder")
    add("--out", metavar="DIR", type=Path, default=Path("certificate"), help="folder of the certificate (certificate)")
    add("--json", action="store_true", help="print the certificate as JSON")
    add(
        "--run",
        dest="carry_out",
        action="store_true",
        help="carry the plan out on a running service's rig: take its steps one by one, measure them, certify",
    )
    add("--frames", metavar="N", type=int, default=1, help="with --run: frames averaged at each step (1)")
    add(
        "--recipe",
        metavar="FILE",
        type=Path,
        help="with --run: region and settings of the analysis; without it those drawn in the test, else the specimen "
        "as it is found and the settings' defaults",
    )
    add("--url", default="http://127.0.0.1:8000", help="with --run: address of the service (default: %(default)s)")
    add("--key", metavar="KEY", help="with --run: key of the service, if it requires one")


def run(args: argparse.Namespace) -> int:
    """Read, judge, write, print; return the verdict's status. With --run, take and measure the steps first."""
    if args.carry_out:
        return _carried_out(args)
    if args.folder is None:
        raise InputError(
            "There is no data folder and there are no results to judge.",
            code="option_conflict",
            remedy="Name the folder before the plan, or take the steps first with --run.",
        )
    # the reports' library takes a second to load
    from stereorig.server.report.certificate.document import make_certificate
    from stereorig.server.report.source import find_source

    plan = load_plan(args.plan)
    source = find_source(args.folder, test=args.test, analysis=args.analysis, calibration=args.calibration)
    progress = ProgressLine()
    try:
        made = make_certificate(
            source,
            plan,
            folder=args.plan.absolute().parent,
            on_step=lambda done, total: progress.show("reading", done / total),
        )
    finally:
        progress.close()
    return _kept(args, made.document, made.page, made.lines, made.outcome)


def _carried_out(args: argparse.Namespace) -> int:
    from stereorig.server.api.models.evidence.certificates import CertificateReply
    from stereorig.server.cli.evidence.procedure import carry_out
    from stereorig.server.cli.recipe import load_recipe

    progress = ProgressLine()
    recipe = None if args.recipe is None else load_recipe(args.recipe)
    try:
        carried = carry_out(
            load_plan(args.plan), args.test, frames=args.frames, url=args.url, key=args.key, recipe=recipe, on=progress
        )
    finally:
        progress.close()
    shown = CertificateReply.model_validate(carried.document)
    lines = [*finding_lines(shown.reasons, shown.suspects), f"verdict: {shown.outcome}", f"certificate {shown.id}"]
    return _kept(args, carried.document, carried.page, lines, shown.outcome)


def _kept(
    args: argparse.Namespace, document: Mapping[str, object], page: bytes, lines: Sequence[str], outcome: str
) -> int:
    """Write a certificate's files, print its findings, return the verdict's status."""
    make_folder(args.out.absolute())
    write_bytes(args.out / "certificate.html", page)
    write_bytes(args.out / "certificate.json", to_json(document))
    if args.json:
        print(json.dumps(document, indent=1))
    else:
        print("\n".join([*lines, f"written: {args.out / 'certificate.html'}, {args.out / 'certificate.json'}"]))
    return OUTCOME_STATUS[outcome]
