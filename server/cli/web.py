"""The web process of ``stereorig serve``: started by its first process, `stereorig.server.http.supervisor`.

``python -m stereorig.server.cli.web CONTROL PARENT ARGUMENTS``: a descriptor of the control socket, the first
process' id, and a JSON object with the fields of :class:`WebArguments`.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.errors import StereorigError
from stereorig.server.base import logs
from stereorig.server.base.priority import die_first, end_with_parent, hurry, raise_file_limit, raise_service, settle
from stereorig.server.cli.operation.serve import default_config, is_loopback, names_of
from stereorig.server.http.server import FrontLink
from stereorig.server.worker.kernel_compiler import compiled_aside


@dataclass(frozen=True)
class WebArguments:
    """Arguments of the web process.

    Parameters
    ----------
    config, data, record, host, log_level, log_format
        As ``stereorig serve`` has them.
    folder
        Folder of the sockets between the service's processes.
    first
        False if another web process of this service has died before.
    """

    config: str | None
    data: str
    record: str | None
    host: str
    log_level: str
    log_format: logs.LogFormat
    folder: str
    first: bool


def serve(asked: WebArguments, link: FrontLink) -> int:
    """Serve until the first process asks for the end."""
    hurry()
    from stereorig.server.compute.functions import warm_up
    from stereorig.server.config.rig_file import load_config
    from stereorig.server.worker.embedded import ComputeWorker

    config = load_config(default_config() if asked.config is None else Path(asked.config))
    # the worker's modules and the service's take about as long: they are loaded side by side
    worker = ComputeWorker(threads=config.service.kernel_threads, warm_up=warm_up)
    worker.start()
    folder = Path(asked.folder)
    try:
        from stereorig.server.api.app import create_app
        from stereorig.server.http.rights import LOOPBACK_NAMES
        from stereorig.server.http.server import WebServer
        from stereorig.server.http.sessions import forget_sessions
        from stereorig.server.rig.process.remote import RemoteRig
        from stereorig.server.workflows.service import Service

        record = None if asked.record is None else Path(asked.record)
        rig = RemoteRig(folder / "rig")
        # an axis that was stopped since a process died moves when its user asks for it
        service = Service(config, Path(asked.data), record=record, worker=worker, devices=rig, home=asked.first)
        service.start()
    except BaseException:
        worker.shutdown()
        raise
    if asked.first:
        forget_sessions(service.folder.root)
    hosts = LOOPBACK_NAMES | names_of(asked.host)
    required = not is_loopback(asked.host) or config.service.require_key
    app = create_app(service, hosts=hosts, keys_required=required)
    about = {
        "name": config.rig.name,
        "data": str(service.folder.root),
        "hosts": sorted(hosts | frozenset(config.service.allowed_hosts)),
        "required": required,
        "max_open": config.service.connections,
    }

    def announce() -> None:
        settle()
        link.ready(about)

    raise_file_limit()
    raise_service()
    server = WebServer(app, service, folder / "web", announce=announce)
    link.serve(service, server)
    server.run()
    return 0


def main() -> int:
    """Serve; the exit status is as the command line's."""
    end_with_parent(int(sys.argv[2]))
    die_first()
    asked = WebArguments(**json.loads(sys.argv[3]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is the first process' to handle
    logs.configure(asked.log_level, asked.log_format, lines_per_s=50)
    (Path(asked.folder) / "web").unlink(missing_ok=True)  # of one that has died
    try:
        with compiled_aside():
            return serve(asked, FrontLink(socket.socket(fileno=int(sys.argv[1]))))
    except StereorigError as error:
        print(f"stereorig: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    raise SystemExit(main())
