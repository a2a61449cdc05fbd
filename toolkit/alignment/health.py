"""Whether the result of an alignment is reliable."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import ResidualScales
from toolkit.alignment.options import HealthLimits


def failure_reason(
    limits: HealthLimits,
    scales: ResidualScales,
    visible_fraction: float,
    information: NDArray[np.float64],
    measured: float,
) -> str:
    """Why an alignment is not reliable; empty if it is.

    Args:
        scales: scales of the residuals.
        visible_fraction: fraction of the frame's measured pixels that the model explains.
        information: [6, 6] information matrix of the pose.
        measured: number of frame pixels with depth.
    """
    if measured < limits.min_measured:
        return f"only {measured:.0f} pixels have depth"
    if visible_fraction < limits.min_visible:
        return f"the map explains only {100 * visible_fraction:.0f} % of the frame"
    if scales.depth_m > limits.max_depth_residual_m:
        return f"depth residual of {100 * scales.depth_m:.1f} cm at 1 m"
    if scales.intensity > limits.max_intensity_residual:
        return f"intensity residual of {scales.intensity:.2f}"
    if not np.isfinite(information).all():
        return "the images hold values that are not finite"
    min_eigenvalue = float(np.linalg.eigvalsh(information)[0])
    if not min_eigenvalue > limits.min_information:
        return f"the view does not fix the pose (information {min_eigenvalue:.1e})"
    return ""
