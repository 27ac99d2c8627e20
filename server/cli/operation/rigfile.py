"""``stereorig rigfile``: check rig files, and print their possible entries."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from stereorig.core.errors import StereorigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = "Check rig files without opening any device; without a file, print every key with its meaning."
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="rig files to check")
    parser.add_argument("--schema", action="store_true", help="print the JSON schema, for editors")


def run(args: argparse.Namespace) -> int:
    """Check or print."""
    from stereorig.server.config.reference import json_schema, markdown
    from stereorig.server.config.rig_file import load_config
    from stereorig.server.rig.build import check_config

    if args.schema:
        print(json.dumps(json_schema(), indent=1))
    elif not args.files:
        print(markdown())
    bad = 0
    for path in args.files:
        try:
            config = load_config(path)
            check_config(config)
        except StereorigError as error:
            bad += 1
            print(error)
        else:
            print(f"{path}: {config.rig.name}, {config.rig.kind}: good")
    return 1 if bad else 0
