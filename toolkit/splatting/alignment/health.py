"""Whether the result of an alignment is reliable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.splatting.alignment.data import ResidualScales


@dataclass(frozen=True)
class HealthLimits:
    """Limits of a reliable alignment.

    Attributes:
        min_measured: minimum number of pixels with a depth measurement.
        min_visible: minimum fraction of the measured pixels that the map explains.
        max_intensity_residual: maximum robust scale of the photometric residuals, for intensities
            in [0, 1].
        max_depth_residual_m: maximum robust scale of the depth residuals at a depth of 1 m.
        min_information: minimum eigenvalue of the pose's information matrix, in 1/m^2 and 1/rad^2.
    """

    min_measured: int = 200
    min_visible: float = 0.15
    max_intensity_residual: float = 0.15
    max_depth_residual_m: float = 0.04
    min_information: float = 1e4


# Limits that only an alignment without any pixels or without information exceeds.
NO_LIMITS = HealthLimits(1, 0.0, 1e9, 1e9, 0.0)


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
