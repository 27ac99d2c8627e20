"""``stereorig bundle``: a test in one file, and back."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.store.bundle.pack import pack
from stereorig.server.store.bundle.unpack import unpack
from stereorig.server.store.verify import require_data_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Pack a test into one ZIP file with all that is needed to measure it again: images, settings, calibrations, "
        "analyses, the SHA-256 of every file, the environment, and RO-Crate metadata, by which repositories show it; a "
        "service may run on the data folder. 'bundle --open FILE' brings such a file into a data folder on which no "
        "service runs, and makes the folder if it is missing: the whole test, or nothing."
    )
    parser.add_argument("test", nargs="?", metavar="TEST", help="id of the test to pack")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="file to write (default: TEST.zip)")
    parser.add_argument("--open", type=Path, metavar="FILE", help="bring this bundle into the data folder instead")
    parser.add_argument("--license", metavar="URL", help="licence of the data, for the metadata: its address or text")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Pack or open."""
    if (args.test is None) == (args.open is None) or (args.open is not None and (args.out or args.license)):
        raise InputError(
            "Give a TEST to pack, or --open FILE without -o and --license.", remedy="See stereorig bundle --help."
        )
    if args.open is not None:
        opened = unpack(args.open, args.data)
        found: dict[str, object] = {"test_id": opened.test_id, "files": opened.files, "bytes": opened.bytes}
        text = f"test {opened.test_id} is in {args.data}: {opened.files} files, {opened.bytes / 2**20:.1f} MiB"
    else:
        require_data_folder(args.data)
        packed = pack(args.data, args.test, args.out or Path(f"{args.test}.zip"), licence=args.license)
        found = {"file": str(packed.file), "files": packed.files, "bytes": packed.bytes, "sha256": packed.sha256}
        size = f"{packed.files} files, {packed.bytes / 2**20:.1f} MiB"
        text = f"{packed.file}: {size}\nsha256 {packed.sha256}"
    print(json.dumps(found, indent=1) if args.json else text)
    return 0
