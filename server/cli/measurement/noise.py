"""``stereorig noise``: from repeated frames of a still scene to noise.json."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from core.errors import InputError
from core.names import CAMERAS
from core.noise import NoiseModel, measure_noise
from server.cli.measurement.image_lists import expand
from server.formats.files import make_folder, sha256_of
from server.formats.noise_frames import read_frames
from server.formats.noise_json import noise_content, write_noise

SHOWN_LEVELS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add(
        "frames",
        nargs="*",
        metavar="FRAMES",
        help="frames of one camera, which then stand for both: two of one make with the same setting",
    )
    add("--cam1", nargs="+", metavar="GLOB", help="camera 1's frames: a quoted pattern or several paths")
    add("--cam2", nargs="+", metavar="GLOB", help="camera 2's frames")
    add(
        "--full-scale",
        type=float,
        metavar="GREY",
        help="grey level at which the converter ends, as 4095 for 12 bits in 16 (found from the frames)",
    )
    add("-o", "--out", required=True, metavar="noise.json", type=Path, help="file to write")


def run(args: argparse.Namespace) -> int:
    """Measure; print a table; write the file."""
    if args.frames and (args.cam1 or args.cam2):
        raise InputError(
            "Both FRAMES and --cam1/--cam2 are given.", code="option_conflict", remedy="Give one or the other."
        )
    wanted = {"FRAMES": args.frames} if args.frames else {cam: getattr(args, cam) for cam in CAMERAS}
    if not any(wanted.values()):
        raise InputError("No frames are given.", code="option_missing", remedy="See stereorig noise --help.")
    if args.out.is_dir():
        raise InputError(f"The output {args.out} is a folder.", code="output_unusable", remedy="Give a file's name.")
    models: dict[str, NoiseModel] = {}
    sources = {}
    for option, items in wanted.items():
        if not items:
            continue
        files, note = expand(option if option == "FRAMES" else f"--{option}", items)
        if note:
            print(f"note: {note}")
        model = measure_noise(read_frames(files), full_scale=args.full_scale)
        source = [{"file": str(file), "sha256": sha256_of(file)} for file in files]
        for cam in CAMERAS if option == "FRAMES" else (option,):
            models[cam], sources[cam] = model, source
        print(report("both cameras" if option == "FRAMES" else option, model))
    make_folder(args.out.absolute().parent)
    write_noise(args.out, noise_content(models, sources=sources))
    print(f"written: {args.out}")
    return 0


def report(name: str, model: NoiseModel) -> str:
    """Write a model as a short table."""
    c, s = model.coefficients, model.coefficients_sd
    terms = [
        f"{value:.4g} +- {sd:.1g}{unit}"
        for value, sd, unit in zip(c, s, ("", " g", " g^2"), strict=True)
        if value != 0.0
    ]
    levels = np.linspace(model.levels[0], model.levels[-1], SHOWN_LEVELS)
    shown = ", ".join(f"{np.sqrt(v):.2f} at {g:.0f}" for g, v in zip(levels, model.variance(levels), strict=True))
    return "\n".join(
        [
            f"{name}: {model.frames} frames",
            f"  variance = {' + '.join(terms)}   (g: grey level; misfit {model.misfit:.2f}, 1 is chance)",
            f"  noise sd: {shown}",
            f"  taken out between frames: brightness {100 * model.drift:.2f} %, motion {model.shift_px:.3f} px",
        ]
    )
