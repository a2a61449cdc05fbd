"""Whether two views determine their relative pose: the rise of the cost beside the minimum.

Gauss-Newton information counts every gradient, those of noise too: a blank wall seems to determine
the pose to millimetres. The cost of the same images at a displaced pose shows the difference. Noise
fits there as well as at the minimum.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toolkit.alignment.backend import linearise
from toolkit.alignment.data import LevelProblem
from toolkit.geometry import se3

# Displacement in the weakest direction: 5 cm or 2 degrees.
_UNITS = np.array([0.05, 0.05, 0.05, 0.035, 0.035, 0.035])


def weakest_rise(problem: LevelProblem) -> float:
    """Relative rise of the cost at 5 cm or 2 degrees in the direction that raises it least.

    Args:
        problem: at its aligned pose.

    Returns:
        The smaller rise of both signs of the direction; 0 if nothing determines the pose.
    """
    here = linearise(problem)
    if not np.isfinite(here.cost) or not np.isfinite(here.H).all():
        return 0.0
    _, directions = np.linalg.eigh(here.H[:6, :6] * np.outer(_UNITS, _UNITS))
    step = _UNITS * directions[:, 0]
    costs = [
        linearise(replace(problem, T_model_frame=se3.exp(sign * step) @ problem.T_model_frame)).cost
        for sign in (-1.0, 1.0)
    ]
    return max(min(costs) / max(here.cost, 1e-9) - 1.0, 0.0)
