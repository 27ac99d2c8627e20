"""``--k`` and ``--coverage``: how wide the intervals are that a command states."""

from __future__ import annotations

import argparse

from stereorig.core.settings import Coverage
from stereorig.server.formats.results.uncertainty import coverage_of


def add_coverage(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the coverage."""
    parser.add_argument(
        "--k", type=float, metavar="K", help="coverage factor of the uncertainties stated (1: standard uncertainty)"
    )
    parser.add_argument(
        "--coverage",
        type=float,
        metavar="SHARE",
        help="instead, the share of a normal distribution that the interval holds, as 0.95",
    )


def coverage_from(args: argparse.Namespace) -> Coverage:
    """Return the coverage that was asked for.

    Raises
    ------
    InputError
        ``option_conflict``, ``coverage_invalid``.
    """
    return coverage_of(args.k, args.coverage)
