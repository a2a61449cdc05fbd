"""Validation of a registration by an independent second method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.loops.registration.result import Registrar, RegistrationResult
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


# Maximum difference of two poses; well above the errors of correct registrations.
_MAX_DISTANCE_M, _MAX_ANGLE_RAD = 0.1, 0.07


class SecondOpinion:
    """Rejects registrations that a second registrar, without an initial pose, contradicts.

    If the second registrar does not converge, the result of the first one is returned.
    """

    def __init__(self, first: Registrar, second: Registrar) -> None:
        self._first, self._second = first, second

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; the result has not converged if the two methods disagree."""
        result = self._first.register(target, source, T_target_source)
        if not result.converged:
            return result
        other = self._second.register(target, source)
        renders = result.renders + other.renders
        if not other.converged:
            return replace(result, renders=renders)
        T = se3.inverse(result.T_target_source) @ other.T_target_source
        distance_m = float(np.linalg.norm(T[:3, 3]))
        angle_rad = float(se3.rotation_angle_rad(T[:3, :3]))
        if distance_m <= _MAX_DISTANCE_M and angle_rad <= _MAX_ANGLE_RAD:
            return replace(result, renders=renders)
        reason = f"{other.method} differs by {100 * distance_m:.0f} cm and {angle_rad:.2f} rad"
        return replace(result, converged=False, renders=renders, reason=reason)
