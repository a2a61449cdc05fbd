"""A registration that another method, which sees other things, must not contradict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.registration.result import Registrar, RegistrationResult
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SecondOpinionOptions:
    """How far two answers may lie apart: well beyond what either errs by where it is right."""

    max_apart_m: float = 0.1
    max_apart_rad: float = 0.07


class SecondOpinion:
    """Asks another registrar from nothing, and refuses what it contradicts.

    Where the other one finds nothing there is no second opinion, and the first one holds.
    """

    def __init__(
        self, first: Registrar, second: Registrar, options: SecondOpinionOptions | None = None
    ) -> None:
        self._first, self._second = first, second
        self.options = options or SecondOpinionOptions()

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; not converged, with the reason, where the two do not agree."""
        result = self._first.register(target, source, T_target_source)
        if not result.converged:
            return result
        other = self._second.register(target, source)
        renders = result.renders + other.renders
        if not other.converged:
            return replace(result, renders=renders)
        apart = se3.inverse(result.T_target_source) @ other.T_target_source
        apart_m = float(np.linalg.norm(apart[:3, 3]))
        apart_rad = float(se3.rotation_angle_rad(apart[:3, :3]))
        if apart_m <= self.options.max_apart_m and apart_rad <= self.options.max_apart_rad:
            return replace(result, renders=renders)
        reason = f"{other.method} has it {100 * apart_m:.0f} cm and {apart_rad:.2f} rad off"
        return replace(result, converged=False, renders=renders, reason=reason)
