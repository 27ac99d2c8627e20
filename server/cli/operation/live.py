"""``stereorig live``: measure a test while it runs."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from typing import Any

from stereorig.core.errors import InputError
from stereorig.server.demo.client import ServiceClient

_WAIT_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``live``."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    begin = actions.add_parser("begin", help="begin a live measurement of a test")
    begin.add_argument("test", metavar="TEST", help="id of the test; its step 0 is the reference")
    for kind, form in (("extensometer", "X0,Y0,X1,Y1"), ("area", "X0,Y0,X1,Y1"), ("point", "X,Y")):
        begin.add_argument(
            f"--{kind}",
            metavar=f"NAME={form}",
            action="append",
            default=[],
            help=f"a gauge, px; may be repeated ({kind})",
        )
    show = actions.add_parser("show", help="print the values of each frame as they come, until interrupted")
    stop = actions.add_parser("stop", help="end it")
    for action in (show, stop):
        action.add_argument("test", metavar="TEST", help="id of the test")
    for action in (begin, show, stop):
        add_service(action)


def add_service(parser: argparse.ArgumentParser) -> None:
    """Declare how the service is reached."""
    parser.add_argument("--url", default="http://127.0.0.1:8000", help="address of the service (default: %(default)s)")
    parser.add_argument("--key", metavar="KEY", help="key of the service, if it requires one")


def client_of(args: argparse.Namespace) -> ServiceClient:
    """Return a client of the service that the arguments name."""
    headers = {} if args.key is None else {"Authorization": f"Bearer {args.key}"}
    return ServiceClient(args.url.rstrip("/"), headers=headers)


def run(args: argparse.Namespace) -> int:
    """Begin, show or end a live measurement."""
    with client_of(args) as client:
        path = f"/tests/{args.test}/live"
        if args.action == "begin":
            body = {
                "extensometers": [_gauge(text, 4, ("a_px", "b_px")) for text in args.extensometer],
                "areas": [_gauge(text, 4, ("rectangle",)) for text in args.area],
                "points": [_gauge(text, 2, ("xy_px",)) for text in args.point],
            }
            print(_state(client.call("POST", path, json=body).json()))
        elif args.action == "stop":
            print(_state(client.call("POST", f"{path}:stop").json()))
        else:
            _show(client, path)
    return 0


def _gauge(text: str, count: int, names: tuple[str, ...]) -> dict[str, str | list[float]]:
    name, _, rest = text.partition("=")
    try:
        numbers = [float(part) for part in rest.split(",")]
    except ValueError:
        numbers = []
    if not name or len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise InputError(
            f"{text!r} is no gauge: give NAME= and {count} numbers with commas between.", code="gauge_unusable"
        )
    each = count // len(names)
    return {"name": name, **{key: numbers[k * each : (k + 1) * each] for k, key in enumerate(names)}}


def _state(live: Mapping[str, Any]) -> str:
    account, port = live["account"], live["tcp_port"]
    fates = ", ".join(f"{account[name]} {name}" for name in ("measured", "skipped", "refused"))
    return f"{live['state']}; frames: {fates}; lines: {'off' if port is None else f'port {port}'}"


def _show(client: ServiceClient, path: str) -> None:
    number = 0
    while True:
        live = client.call("GET", path).json()
        values = live["values"]
        if values["number"] > number or not values["valid"]:
            number = values["number"]
            parts = [_text(name, gauge) for name, gauge in values["gauges"].items()]
            print(f"{number} {values.get('exposed_utc') or ''} {'  '.join(parts) or values['reason']}", flush=True)
        if live["state"] not in ("starting", "running"):
            print(_state(live))
            return
        time.sleep(_WAIT_S)


def _text(name: str, gauge: Mapping[str, Any]) -> str:
    if not gauge["valid"]:
        return f"{name}: not valid ({gauge['reason']})"
    shown = {"extensometer": "strain", "area": "eyy", "point": "w_mm"}[gauge["kind"]]
    number = gauge["values"][shown]
    u = "" if number["u"] is None else f" +- {number['u']:.2g}"
    return f"{name}: {shown} {number['value']:.6g}{u}"
