"""What a registration says, and who may say it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import ResidualScales
from toolkit.geometry import se3
from toolkit.submaps.submap import Submap

UNKNOWN = ResidualScales(float("nan"), float("nan"))


@dataclass(frozen=True)
class RegistrationResult:
    """Where a source submap lies in a target's frame, and how far that can be trusted.

    Attributes:
        T_target_source: [4, 4] float64; the start, or identity, where nothing was found.
        converged: the optimiser came to rest on enough common pixels.
        inliers: share of the overlapping pixels whose surfaces agree; of the pairs of
            keyframes that agree, where only those were compared.
        residual: robust scales of intensity and of depth at 1 m (m), nan where not measured.
        overlap: share of the source's pixels that the target shows as well.
        class_agreement: share of the overlapping labelled pixels of the same class, nan
            without semantics.
        information: [6, 6] inverse covariance of x in T_target_source exp(x), translation
            first.
        iterations, renders: steps taken (0 where Open3D does not tell), views drawn.
        method: how it was found.
        reason: why it did not converge, empty where it did.
    """

    T_target_source: NDArray[np.float64]
    converged: bool
    inliers: float
    residual: ResidualScales
    overlap: float
    class_agreement: float
    information: NDArray[np.float64] = field(repr=False)
    iterations: int
    renders: int
    method: str
    reason: str = ""

    def quality_values(self) -> dict[str, Any]:
        """What a log or a report tells of it; None, which JSON knows, for what was not measured."""
        values = {
            "method": self.method,
            "overlap": self.overlap,
            "inliers": self.inliers,
            "class_agreement": self.class_agreement,
            "intensity": self.residual.intensity,
            "depth_m": self.residual.depth_m,
        }
        return {
            k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()
        }

    def inverted(self) -> RegistrationResult:
        """The same registration with the roles of the submaps exchanged.

        (T exp(x))^-1 = T^-1 exp(-Ad(T) x), so the information moves by Ad(T)^-1.
        """
        A = se3.adjoint(se3.inverse(self.T_target_source))
        return replace(
            self,
            T_target_source=se3.inverse(self.T_target_source),
            information=A.T @ self.information @ A,
        )


def failed(
    method: str, reason: str, T_target_source: NDArray[np.float64] | None = None
) -> RegistrationResult:
    """A registration that found nothing, with the start it was given."""
    return RegistrationResult(
        T_target_source=np.eye(4) if T_target_source is None else T_target_source.copy(),
        converged=False,
        inliers=0.0,
        residual=UNKNOWN,
        overlap=0.0,
        class_agreement=float("nan"),
        information=np.zeros((6, 6)),
        iterations=0,
        renders=0,
        method=method,
        reason=reason,
    )


class Registrar(Protocol):
    """Registers submaps."""

    def register(
        self, target: Submap, source: Submap, T_target_source: NDArray[np.float64] | None = None
    ) -> RegistrationResult:
        """Where the source lies in the target's frame.

        Args:
            T_target_source: [4, 4] where to begin, or None to begin from nothing.
        """
        ...


def register_pair(
    registrar: Registrar,
    first: Submap,
    second: Submap,
    T_first_second: NDArray[np.float64] | None = None,
) -> RegistrationResult:
    """T_first_second of two submaps, the one with more keyframes taken as the target (G).

    At equal counts the first one is. The result is `T_first_second` either way.
    """
    if len(first.keyframes) >= len(second.keyframes):
        return registrar.register(first, second, T_first_second)
    start = None if T_first_second is None else se3.inverse(T_first_second)
    return registrar.register(second, first, start).inverted()
