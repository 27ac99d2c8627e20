"""Writes server/api/docs/examples.json: an example of each request and each answer, as a small simulated rig gave them.

The session behind it is tests/support/api_scenario.py; it goes through every operation once. Long lists and texts are cut short.

    python -m tests.bench.documents.api_examples && python -m tests.bench.documents.openapi
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from tests.support.requirements import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from server.api.app import bare_app
from server.api.docs.openapi import EXAMPLES
from server.config.rig_file import parse_config
from server.workflows.service import Service
from tests.support.api_scenario import Session, run, short
from tests.support.service_rig import SMALL, served


def examples_of(session: Session) -> dict[str, dict[str, object]]:
    """Return what the file holds of a session."""
    found: dict[str, dict[str, object]] = {}
    for operation in sorted(session.operations):
        requests: dict[str, dict[str, object]] = {}
        for sent in session.requests:
            if sent.operation == operation:
                requests.setdefault(sent.media_type, {})[sent.summary] = sent.value
        replies = {
            status: {media: short(value) for media, value in forms.items() if value is not None}
            for status, forms in session.replies[operation].items()
        }
        found[operation] = {"requests": requests, "replies": {s: forms for s, forms in replies.items() if forms}}
    return found


def main() -> None:
    """Run the session and write the file."""
    with tempfile.TemporaryDirectory() as folder:
        service = Service(parse_config(SMALL), Path(folder) / "data").start()
        try:
            with served(service) as client:
                session = run(client, bare_app().openapi())
        finally:
            service.close()
    EXAMPLES.write_text(json.dumps(examples_of(session), indent=1, ensure_ascii=False, sort_keys=True) + "\n")
    print(f"{EXAMPLES} is written")


if __name__ == "__main__":
    main()
