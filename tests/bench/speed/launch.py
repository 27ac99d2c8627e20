"""Start a program from a small process, and write what it took: ``python -I -S launch.py REPORT PROGRAM ...``.

A process counts the memory of the one that started it as its own until it has loaded its program, and the kernel keeps
that peak: started by the bench itself, none would have taken less than the bench.
"""

import json
import os
import sys
import time
from pathlib import Path


def main() -> int:
    """Run the program to its end; return what it returns."""
    report, *program = sys.argv[1:]
    start = time.perf_counter()
    _, status, used = os.wait4(os.posix_spawn(program[0], program, os.environ), 0)
    took = {"wall_s": time.perf_counter() - start, "cpu_s": used.ru_utime + used.ru_stime, "peak": used.ru_maxrss}
    Path(report).write_text(json.dumps(took))
    return os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    raise SystemExit(main())
