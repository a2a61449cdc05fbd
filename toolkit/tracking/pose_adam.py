"""Adam on a camera pose: for the first-order tracker and for local bundle adjustment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15

MOMENTS = 13  # first and second moments of six coordinates, and the number of steps


def pose_gradient(
    by_matrix: NDArray[np.float64], T_camera_map: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative [6] by xi of exp(xi) @ T_camera_map, from that by its entries [3, 4].

    A rotation phi moves each column c of the matrix by phi x c, so its share of the
    derivative is phi . (c x g); only the translation's column moves with rho.
    """
    by_rotation = np.cross(T_camera_map[:3], by_matrix, axis=0).sum(axis=1)
    return np.concatenate([by_matrix[:, 3], by_rotation])


class PoseAdam:
    """Adam over the six tangent coordinates, with a rate for each kind.

    Args:
        translation_rate: metres a step. rotation_rate: radians a step.
        moments: [13] where an earlier one stopped; changed in place.
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
        """The tangent step [6] that a gradient [6] asks for."""
        first, second = self.moments[:6], self.moments[6:12]
        first[:] = _BETA1 * first + (1.0 - _BETA1) * gradient
        second[:] = _BETA2 * second + (1.0 - _BETA2) * gradient**2
        self.moments[12] += 1
        steps = self.moments[12]
        mean = first / (1.0 - _BETA1**steps)
        spread = np.sqrt(second / (1.0 - _BETA2**steps))
        return -self._rates * mean / (spread + _EPSILON)
