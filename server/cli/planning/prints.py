"""``stereorig print``: targets and speckle in true millimetres, and the measured scale of a print."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.formats.calibrations.target_toml import load_toml, read_target
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.prints.drawing import DRAWING_FORMS, PrintedPage
from stereorig.server.formats.prints.measured import measured_print
from stereorig.server.formats.prints.page import PAPER_HELP
from stereorig.server.formats.prints.speckle import speckle_mm, speckle_page
from stereorig.server.formats.prints.targets import target_drawing, title_of, unmeasured_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Write a calibration target or speckle as a page for a printer, with rulers to check its scale."
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    target = actions.add_parser("target", help="a target of any kind; beside it the target file of the print")
    target.add_argument("file", metavar="TARGET.toml", type=Path, help="its description, or a rig file")
    target.add_argument("--marks", action="store_true", help="dots in rows and columns: three rings mark the axes")
    speckle = actions.add_parser("speckle", help="a speckle pattern of a stated size and black share")
    add = speckle.add_argument
    add("--speckle-mm", type=float, metavar="MM", help="diameter of a disc; left out: by --speckle-px and --rig")
    add("--speckle-px", type=float, metavar="PX", default=4.0, help="the same in the images, 3 to 5 (default: 4)")
    add("--rig", metavar="RIG.toml", type=Path, help="rig file, whose lenses and distances size a pixel")
    add("--share", type=float, default=0.5, help="black share of the area, 0.2 to 0.7 (default: 0.5)")
    add("--seed", type=int, default=1, help="names the pattern: the same seed is the same pattern (default: 1)")
    for page in (target, speckle):
        page.add_argument("--out", metavar="PAGE", type=Path, required=True, help="page to write, .pdf or .svg")
        page.add_argument("--paper", default="A4", help=f"{PAPER_HELP} (default: A4)")
        page.add_argument("--margin-mm", type=float, default=10.0, metavar="MM", help="unprinted rim (default: 10)")
    measured = actions.add_parser("measured", help="bring the measured rulers of a print into its target file")
    measured.add_argument("file", metavar="TARGET.toml", type=Path, help="file beside the print; it is written again")
    for option, text in (
        ("--printed-mm", "length by the ruler's numbers; two: across and down"),
        ("--measured-mm", "the same length as measured on the print"),
    ):
        measured.add_argument(option, metavar="MM", type=float, nargs="+", required=True, help=text)
    measured.add_argument(
        "--u-mm", metavar="MM", type=float, required=True, help="standard uncertainty (k = 1) of a measured length"
    )


def run(args: argparse.Namespace) -> int:
    """Draw and write, or bring a measured scale in."""
    if args.action == "measured":
        return _measured(args)
    page = {"paper": args.paper, "margin_mm": args.margin_mm}
    if args.action == "speckle":
        diameter = speckle_mm(args.speckle_mm, args.speckle_px, None if args.rig is None else _mm_per_px(args.rig))
        _write(args.out, speckle_page(diameter, share=args.share, seed=args.seed, **page))
        return 0
    target = read_target(args.file)
    drawing = target_drawing(target, marks=args.marks, **page)
    _write(args.out, drawing)
    beside = args.out.with_suffix(".toml")
    write_bytes(beside, unmeasured_text(target).encode())
    print(f"written: {beside}; measure the print's rulers, then: stereorig print measured {beside} ...")
    return 0


def _write(path: Path, drawing: PrintedPage) -> None:
    form = path.suffix.removeprefix(".")
    if form not in DRAWING_FORMS:
        raise InputError(f"--out {path} is neither .pdf nor .svg.", remedy="Name the page NAME.pdf or NAME.svg.")
    make_folder(path.absolute().parent)
    write_bytes(path, drawing.data(form))
    print(f"{drawing.title}\nwritten: {path}, {drawing.width_mm:g} x {drawing.height_mm:g} mm")


def _measured(args: argparse.Namespace) -> int:
    content = load_toml(args.file, kind="target description")
    found = measured_print(content, str(args.file), args.printed_mm, args.measured_mm, args.u_mm)
    write_bytes(args.file, found.text.encode())
    print(f"{title_of(found.target)}\nscale {found.scale:.6f}, standard uncertainty {found.sigma:.2g}")
    if found.stretch is None:
        print("note: one direction was measured; that the other one has the same scale is not known")
    else:
        tolerance = found.target.node_tolerance_mm
        print(f"directions differ by {200.0 * found.stretch:.2g} %: node_tolerance_mm {tolerance:.3g}")
    print(f"written: {args.file}")
    return 0


def _mm_per_px(path: Path) -> float | None:
    from stereorig.server.config.rig_file import load_config

    return load_config(path).mm_per_px
