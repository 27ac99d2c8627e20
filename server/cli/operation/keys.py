"""``stereorig keys``: make, list and remove the keys of a service."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.http.access import ROLES, KeyFile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Keys let people and scripts in where the service asks for them: always on addresses other than loopback. A "
        "viewer may read and stop the stage, an operator may also move, capture and measure, an admin may also delete."
    )
    parser.add_argument("action", choices=["add", "list", "remove"])
    parser.add_argument("name", nargs="?", metavar="NAME", help="name of the key: its user or program")
    parser.add_argument("--role", choices=ROLES, help="of a new key")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")


def run(args: argparse.Namespace) -> int:
    """Do it; a new key is printed once and nowhere kept."""
    if not args.data.is_dir():
        raise InputError(
            f"There is no data folder {args.data}.",
            code="no_data_folder",
            remedy="Name the one that 'stereorig serve --data' was given, or make it.",
        )
    keys = KeyFile(args.data)
    if args.action == "list":
        for stored in keys.keys():  # noqa: SIM118  # a method of the file
            print(f"{stored.name}  {stored.role}  made {stored.created_utc}")
        return 0
    if args.name is None:
        raise InputError(f"'keys {args.action}' needs a NAME.", remedy="See stereorig keys --help.")
    if args.action == "remove":
        keys.remove(args.name)
        return 0
    if args.role is None:
        raise InputError("'keys add' needs --role.", remedy=f"Give one of {', '.join(ROLES)}.")
    print(keys.add(args.name, args.role))
    return 0
