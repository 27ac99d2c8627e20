"""``stereorig serve``: start the service on a rig."""

from __future__ import annotations

import argparse
import contextlib
import ipaddress
import logging
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from core.errors import FileFormatError, InputError

DEFAULT_CONFIG = "sim_paper.toml"
DEFAULT_PORT = 8000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--config", type=Path, help=f"rig file (default: config/{DEFAULT_CONFIG})")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"port, 0 for any (default: {DEFAULT_PORT})")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")
    parser.add_argument(
        "--log-level", default="warning", choices=["debug", "info", "warning", "error"], help="log level"
    )


def default_config() -> Path:
    """Find the simulated paper rig's file: in the checkout, the working folder, or the installation.

    Raises
    ------
    FileFormatError
        ``file_missing`` if there is none.
    """
    places = [
        Path(__file__).resolve().parents[2] / "config",
        Path.cwd() / "config",
        Path(sys.prefix) / "share" / "stereorig" / "config",
    ]
    for place in places:
        if (place / DEFAULT_CONFIG).is_file():
            return place / DEFAULT_CONFIG
    raise FileFormatError(
        f"No config/{DEFAULT_CONFIG} was found.", code="file_missing", remedy="Name a rig file with --config."
    )


def check_host(host: str) -> None:
    """Refuse to listen on anything but loopback: there are no keys yet.

    Raises
    ------
    InputError
        ``bind_needs_keys``.
    """
    if host == "localhost":
        return
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise InputError(
            f"Listening on {host} would let anybody on the network move the stage: access keys are needed for that.",
            code="bind_needs_keys",
            remedy="Use --host 127.0.0.1, and a tunnel (ssh -L) from other machines.",
        )


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio switches Nagle's delay off only where the protocol is named
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise InputError(
            f"Port {port} of {host} cannot be used: {error}.",
            code="port_unusable",
            remedy="Give another --port; 0 takes any.",
        ) from error
    return listener


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    check_host(args.host)
    logging.basicConfig(level=args.log_level.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    import uvicorn

    from server.api.app import create_app
    from server.api.guard import LOOPBACK_NAMES
    from server.config import load_config
    from server.service import Service

    config = load_config(args.config or default_config())
    listener = _listen(args.host, args.port)
    try:
        service = Service(config, args.data)
    except BaseException:
        listener.close()
        raise
    app = create_app(service, hosts=LOOPBACK_NAMES | {args.host})
    name = f"[{args.host}]" if ":" in args.host else args.host
    url = f"http://{name}:{listener.getsockname()[1]}"

    class AnnouncingServer(uvicorn.Server):
        @contextlib.contextmanager
        def capture_signals(self) -> Iterator[None]:
            # uvicorn raises a signal again after its shutdown, which would end the process before it is tidy
            earlier = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
            try:
                yield
            finally:
                for number, handler in earlier.items():
                    signal.signal(number, handler)

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=sockets)
            if self.started:
                print(f"stereorig serves the {config.rig.name} on {url} (data in {service.folder.root})", flush=True)

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            service.stop_streams()  # or the server would wait for them
            await super().shutdown(sockets=sockets)

    settings = uvicorn.Config(
        app, log_level=args.log_level, access_log=False, timeout_graceful_shutdown=3, lifespan="on"
    )
    AnnouncingServer(settings).run(sockets=[listener])
    return 0
