"""Array types."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Floats = Float | Float32
"""A common factor just made is in single precision, which holds its digits; one read from a file is in double."""
