"""Compile a process' missing kernels in another process, so that it takes them from disk as every later one will.

In the process that compiles it, a kernel calls the functions that were compiled before it, each by itself; on disk it
has its own copies of them, optimised as parts of it, which round otherwise. A measurement would differ in its last
digits from its own repetition.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from stereorig.core.compiling import ENTRIES, compile_elsewhere, no_collection
from stereorig.core.lazy import load_module
from stereorig.server.base.priority import end_with_parent

_DONE = b"\n"


class KernelCompiler:
    """A process that compiles kernels on request, started with the first one.

    One process serves several kernels: their common parts are compiled once.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def compile(self, module: str, name: str, arguments: Any) -> None:
        """Return once a kernel is on disk, or will have to be compiled here.

        Parameters
        ----------
        module, name
            The module that makes the kernel, and its qualified name.
        arguments
            numba's types of its arguments.
        """
        # a process that ended by itself, for want of memory perhaps, leaves the work to the caller
        with contextlib.suppress(OSError):
            if self._process is not None and self._process.poll() is not None:
                self.close()  # it ends with the thread that started it
            process = self._process = self._process or _start()
            assert process.stdin is not None
            assert process.stdout is not None
            pickle.dump((module, name, arguments), process.stdin)
            process.stdin.flush()
            process.stdout.read(len(_DONE))

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            process, self._process = self._process, None
            process.kill()
            with contextlib.suppress(OSError), process:  # a question that it did not hear
                pass


@contextlib.contextmanager
def compiled_aside() -> Iterator[None]:
    """Have kernels that are not on disk compiled by another process inside the block."""
    with contextlib.closing(KernelCompiler()) as compiler, compile_elsewhere(compiler.compile):
        yield


def start_module(name: str, *arguments: str, talks: bool = False) -> subprocess.Popen[bytes]:
    """Start a module in a process that finds this program as this one does; ``talks``: with pipes to it and back."""
    pipe = subprocess.PIPE if talks else subprocess.DEVNULL
    return subprocess.Popen(
        [sys.executable, "-m", name, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        stdin=pipe,
        stdout=pipe,
        stderr=subprocess.DEVNULL,
    )


def _start() -> subprocess.Popen[bytes]:
    return start_module(__name__, talks=True)


def main() -> int:
    """Compile the kernels that the parent asks for, until it closes the pipe."""
    end_with_parent()
    with no_collection():
        while True:
            try:
                module, name, arguments = pickle.load(sys.stdin.buffer)
            except EOFError:
                return 0
            load_module(module)
            ENTRIES[module, name].compiled.compile(arguments)
            sys.stdout.buffer.write(_DONE)
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    raise SystemExit(main())
