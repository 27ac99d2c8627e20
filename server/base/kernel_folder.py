"""Folder of compiled kernels: next to their sources, in the user's cache, or the one in ``NUMBA_CACHE_DIR``.

numba refuses to load a kernel that it may keep if none of these can be written, as under a user without a home on
an installation that another user owns. The command line then keeps them for as long as it runs.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from stereorig import core

# the package itself takes seconds to load
_KERNELS = Path(core.__file__).parent / "matching" / "kernels"
_temporary: Path | None = None


def kernel_folders(kernels: Path = _KERNELS) -> list[Path]:
    """Return the folders that numba tries, in its order; the first one that can be written is taken."""
    own = named_folder()
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.path.expanduser("~")) / ".cache")  # noqa: PTH111 - no error
    return [*([] if own is None else [own]), kernels / "__pycache__", home / "numba"]


def named_folder() -> Path | None:
    """Return the folder that the user named."""
    own = os.environ.get("NUMBA_CACHE_DIR")
    return Path(own) if own and Path(own) != _temporary else None


def can_write(folder: Path) -> bool:
    """Return True if a file could be made in a folder that exists, or that would have to be made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def ensure_kernel_folder() -> None:
    """Keep kernels in a folder of this process, removed at its end, if they can be kept nowhere else."""
    global _temporary
    if _temporary is None and not any(map(can_write, kernel_folders())):
        _temporary = Path(tempfile.mkdtemp(prefix="stereorig-kernels-"))
        os.environ["NUMBA_CACHE_DIR"] = str(_temporary)
        atexit.register(shutil.rmtree, _temporary, ignore_errors=True)
