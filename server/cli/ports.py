"""TCP ports that a command listens on."""

from __future__ import annotations

import argparse

from stereorig.core.errors import InputError


def check_port(args: argparse.Namespace) -> None:
    """Raise an error if ``--port`` cannot be one."""
    if not 0 <= args.port <= 65535:
        raise InputError(f"--port {args.port} is not from 0 to 65535.")


def port_unusable(port: str, error: Exception) -> InputError:
    """Return the error for a port that the machine does not give; ``port`` as the user gave it."""
    return InputError(
        f"Port {port} cannot be used: {error}.", code="port_unusable", remedy="Give another --port; 0 takes any."
    )
