"""Linear systems whose solution does not depend on the number of threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Dense solvers use one thread for systems of up to this size.
_DENSE = 16


def solve_reproducibly(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution [N] or [N, M] of A x = b for a matrix [N, N] of few values that are not 0.

    Dense solvers round differently with several threads.
    """
    if len(A) <= _DENSE:
        return np.asarray(np.linalg.solve(A, b))
    # Not at the top: tracking and mapping of a few images run where only PyTorch is installed.
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    return np.asarray(splu(csc_array(A)).solve(b))
