"""``stereorig noise``: from repeated frames of a still scene to noise.json."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS
from stereorig.core.noise import NoiseModel, measure_noise, measure_pattern
from stereorig.server.cli.measurement.image_lists import expand
from stereorig.server.formats.files import make_folder, sha256_of
from stereorig.server.formats.noise_json import noise_content, read_frames, stated_full_scale, write_noise

SHOWN_LEVELS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add(
        "frames",
        nargs="*",
        metavar="FRAMES",
        help="frames of one camera, used for both: two of one make with the same setting",
    )
    add("--cam1", nargs="+", metavar="GLOB", help="camera 1's frames: a quoted pattern or several paths")
    add("--cam2", nargs="+", metavar="GLOB", help="camera 2's frames")
    add(
        "--even1",
        nargs="+",
        metavar="GLOB",
        help="camera 1's frames of an even field (a diffuser, far out of focus): a map of its fixed pattern and "
        "defective pixels goes into the file, and is taken off images that are measured with it",
    )
    add("--even2", nargs="+", metavar="GLOB", help="camera 2's frames of an even field")
    add(
        "--full-scale",
        type=float,
        metavar="GREY",
        help="grey level at which the converter ends, as 4095 for 12 bits in 16 (the files' own, or found from them)",
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
    sources: dict[str, Any] = {}
    for option, items in wanted.items():
        if not items:
            continue
        files, note = expand(option if option == "FRAMES" else f"--{option}", items)
        if note:
            print(f"note: {note}")
        model = measure_noise(read_frames(files), full_scale=args.full_scale or stated_full_scale(files[0]))
        source = [{"file": str(file), "sha256": sha256_of(file)} for file in files]
        for cam in CAMERAS if option == "FRAMES" else (option,):
            models[cam], sources[cam] = model, source
        print(report("both cameras" if option == "FRAMES" else option, model))
    for cam, items in zip(CAMERAS, (args.even1, args.even2), strict=True):
        if items:
            even(cam, items, models, sources)
    make_folder(args.out.absolute().parent)
    write_noise(args.out, noise_content(models, sources=sources))
    print(f"written: {args.out}")
    return 0


def even(cam: str, items: list[str], models: dict[str, NoiseModel], sources: dict[str, Any]) -> None:
    """Add the map of a camera's sensor to its model."""
    option = f"--even{cam[-1]}"
    if cam not in models:
        raise InputError(
            f"{option} is given without frames of {cam}'s noise.",
            code="option_missing",
            remedy=f"Give --{cam} too: frames of the specimen at rest.",
        )
    files, note = expand(option, items)
    if note:
        print(f"note: {note}")
    sensor = measure_pattern(read_frames(files, whole=True))
    models[cam] = replace(models[cam], sensor=sensor)
    sources[cam] = [*sources[cam], *({"file": str(file), "sha256": sha256_of(file), "even": True} for file in files)]
    print(f"{cam}: fixed pattern {sensor.pattern.std():.2f} grey levels (sd), {len(sensor.defects)} defective pixels")


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
