"""Adam on a camera pose, for local bundle adjustment and the first-order baselines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15

MOMENTS = 13  # first and second moments of six coordinates, and the number of steps


def pose_gradient(
    matrix_gradient: NDArray[np.float64], T_camera_map: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative [6] with respect to the tangent xi of exp(xi) @ T_camera_map.

    A rotation phi changes each column c of the matrix by phi x c, which contributes
    phi . (c x g) to the derivative. A translation changes the last column only.

    Args:
        matrix_gradient: [3, 4] derivative g with respect to the matrix entries.
    """
    rotation_gradient = np.cross(T_camera_map[:3], matrix_gradient, axis=0).sum(axis=1)
    return np.concatenate([matrix_gradient[:, 3], rotation_gradient])


class PoseAdam:
    """Adam over the six tangent coordinates.

    Args:
        translation_rate: learning rate in metres.
        rotation_rate: learning rate in radians.
        moments: [13] state of an earlier optimiser to continue from; changed in place.
    """

    def __init__(
        self,
        translation_rate: float,
        rotation_rate: float,
        moments: NDArray[np.float64] | None = None,
    ) -> None:
        self._rates = np.repeat([translation_rate, rotation_rate], 3)
        self.moments = np.zeros(MOMENTS) if moments is None else moments

    def step(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """The tangent step [6] for a gradient [6]."""
        first, second = self.moments[:6], self.moments[6:12]
        first[:] = _BETA1 * first + (1.0 - _BETA1) * gradient
        second[:] = _BETA2 * second + (1.0 - _BETA2) * gradient**2
        self.moments[12] += 1
        steps = self.moments[12]
        mean = first / (1.0 - _BETA1**steps)
        deviation = np.sqrt(second / (1.0 - _BETA2**steps))
        return -self._rates * mean / (deviation + _EPSILON)
