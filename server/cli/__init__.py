"""The ``stereorig`` command."""

import os

# our threads are our own: a second set, of the linear algebra library, only gets in their way. Read when it is loaded
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from stereorig.server.base.kernel_folder import ensure_kernel_folder  # noqa: E402
from stereorig.server.base.priority import end_at_once  # noqa: E402
from stereorig.server.cli.main import main  # noqa: E402

end_at_once()
ensure_kernel_folder()  # numba reads it when it is loaded

__all__ = ["main"]
