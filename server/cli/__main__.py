"""``python -m stereorig.server.cli``: the command, if it is not installed."""

import sys

from stereorig.server.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
