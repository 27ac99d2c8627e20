"""The command line, where its script is not in the path: ``python -m stereorig``."""

from __future__ import annotations

import sys

from stereorig.server.cli import main

if __name__ == "__main__":
    sys.exit(main())
