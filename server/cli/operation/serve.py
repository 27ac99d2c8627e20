"""``stereorig serve``: start the service on a rig."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ipaddress
import logging
import socket
import ssl
import sys
from pathlib import Path

from stereorig.core.errors import FileFormatError, InputError
from stereorig.server.base import logs
from stereorig.server.base.priority import settle
from stereorig.server.cli.ports import port_unusable
from stereorig.server.http.access import KeyFile

DEFAULT_CONFIG = "sim_paper.toml"
DEFAULT_PORT = 8000
_PLAIN = (
    "keys and images travel unencrypted over plain http: any computer there can read them. Give --tls-cert and "
    "--tls-key, or put a proxy that speaks https in front."
)
# enough for a fast network at a short distance; more would only keep old pictures for slow readers
_SEND_BUFFER_BYTES = 256 * 1024

_log = logging.getLogger("stereorig.serve")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--config", type=Path, help=f"rig file (default: config/{DEFAULT_CONFIG})")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"port, 0 for any (default: {DEFAULT_PORT})")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="write a transcript of the stage's wire to FILE, for reports of trouble",
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="serve by https with this certificate (PEM)")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="key of the certificate (PEM)")
    parser.add_argument(
        "--log-level", default="warning", choices=["debug", "info", "warning", "error"], help="log level"
    )
    parser.add_argument(
        "--log-format", default="text", choices=logs.FORMATS, help="lines for people, or JSON lines (default: text)"
    )


def default_config() -> Path:
    """Find the simulated paper rig's file: in the checkout, the working folder, or the installation.

    Raises
    ------
    FileFormatError
        ``file_missing`` if there is none.
    """
    folders = [
        Path(__file__).resolve().parents[3] / "config",
        Path.cwd() / "config",
        Path(sys.prefix) / "share" / "stereorig" / "config",
    ]
    for folder in folders:
        if (folder / DEFAULT_CONFIG).is_file():
            return folder / DEFAULT_CONFIG
    raise FileFormatError(
        f"No config/{DEFAULT_CONFIG} was found.", code="file_missing", remedy="Name a rig file with --config."
    )


def is_loopback(host: str) -> bool:
    """Return True if only this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def names_of(host: str) -> frozenset[str]:
    """Return the names under which clients may address a service that listens there."""
    names = {host}
    if not is_loopback(host):
        names |= {socket.gethostname(), socket.getfqdn()}
        with contextlib.suppress(OSError):  # a machine that cannot look up its own name
            names |= {str(entry[4][0]) for entry in socket.getaddrinfo(socket.gethostname(), None)}
    return frozenset(names)


def check_host(host: str, keys: KeyFile) -> None:
    """Refuse to listen on anything but loopback while there are no keys.

    Raises
    ------
    InputError
        ``bind_needs_keys``.
    """
    if not is_loopback(host) and not keys.keys():
        raise InputError(
            f"Listening on {host} would let any computer there move the stage: access keys are needed for that.",
            code="bind_needs_keys",
            remedy="Make one: stereorig keys add NAME --role operator --data DATA. Or use --host 127.0.0.1.",
        )


def check_tls(certificate: Path | None, key: Path | None) -> None:
    """Refuse half of a pair, and files that are no certificate and key, before anything is opened.

    Raises
    ------
    InputError
        ``tls_unusable``.
    """
    if certificate is None and key is None:
        return
    remedy = "Give --tls-cert and --tls-key, both in PEM form."
    if certificate is None or key is None:
        raise InputError("TLS needs both a certificate and its key.", code="tls_unusable", remedy=remedy)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except OSError as error:  # ssl.SSLError is one
        raise InputError(
            f"{certificate} and {key} are no certificate with its key: {error}.", code="tls_unusable", remedy=remedy
        ) from error


def tls_is_missing(host: str, certificate: Path | None) -> bool:
    """Return True if keys would travel where others can read them."""
    return certificate is None and not is_loopback(host)


def check_record(path: Path) -> None:
    """Refuse a transcript that cannot be written before anything is opened.

    Raises
    ------
    InputError
        ``record_unusable``.
    """
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise InputError(
            f"The transcript {path} cannot be written: {error.strerror}.",
            code="record_unusable",
            remedy="Name a file in an existing folder that can be written with --record.",
        ) from error


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio switches Nagle's delay off only where the protocol is named
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    # accepted connections inherit both
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise port_unusable(f"{port} of {host}", error) from error
    return listener


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    keys = KeyFile(args.data)
    check_host(args.host, keys)
    check_tls(args.tls_cert, args.tls_key)
    logs.configure(args.log_level, args.log_format, lines_per_s=20)
    from stereorig.server.base.priority import raise_file_limit, raise_service
    from stereorig.server.http.supervisor import ServePlan, Supervisor
    from stereorig.server.http.systemd import Notifier

    if args.record is not None:
        check_record(args.record)
    listener = _listen(args.host, args.port)
    raise_file_limit()
    raise_service()
    if tls_is_missing(args.host, args.tls_cert):
        _log.warning("%s", _PLAIN)
    scheme, tls = "http", None
    if args.tls_cert is not None:
        scheme, tls = "https", ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.load_cert_chain(args.tls_cert, args.tls_key)
    host = f"[{args.host}]" if ":" in args.host else args.host
    url = f"{scheme}://{host}:{listener.getsockname()[1]}"
    plan = ServePlan(
        data=args.data,
        web={
            "config": None if args.config is None else str(args.config),
            "data": str(args.data),
            "record": None if args.record is None else str(args.record),
            "host": args.host,
            "log_level": args.log_level,
            "log_format": args.log_format,
        },
        log_level=args.log_level,
        log_format=args.log_format,
        scheme=scheme,
    )

    def announce(name: str, data: str) -> None:
        settle()
        print(f"stereorig serves the {name} on {url} (data in {data})", flush=True)

    return asyncio.run(Supervisor(plan, listener, tls=tls, notifier=Notifier(), announce=announce).run())
