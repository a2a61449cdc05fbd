"""Result and interface of the registration of submaps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import ResidualScales

UNKNOWN = ResidualScales(float("nan"), float("nan"))


@dataclass(frozen=True)
class RegistrationResult:
    """Pose of a source submap in the frame of a target, with measures of its quality.

    Attributes:
        T_target_source: [4, 4] float64; the initial pose, or the identity, if registration failed.
        converged: whether the optimiser converged with enough overlapping pixels.
        inliers: fraction of the overlapping pixels whose depths agree; for coarse registration,
            fraction of the keyframe pairs that agree.
        residual: robust scales of intensity and of depth at 1 m (m); nan if unknown.
        overlap: fraction of the source's pixels that overlap with the target.
        class_agreement: fraction of the labelled pixels with the same class; nan without
            semantics.
        information: [6, 6] inverse covariance of x in T_target_source exp(x), translation
            first.
        iterations: number of steps; 0 for Open3D, which does not report it.
        renders: number of rendered views.
        method: name of the method.
        reason: why it did not converge; empty if it did.
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
        """Method and quality for logs and reports; values that are not finite become None."""
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

        (T exp(x))^-1 = T^-1 exp(-Ad(T) x), so the information is transformed by Ad(T)^-1.
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
    """Result of a registration that failed, with the initial pose if there was one."""
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
        """Estimate the pose of the source in the target's frame.

        Args:
            T_target_source: initial pose [4, 4]; None for registration without an initial pose.
        """
        ...


def register_pair(
    registrar: Registrar,
    first: Submap,
    second: Submap,
    T_first_second: NDArray[np.float64] | None = None,
) -> RegistrationResult:
    """Register two submaps, with the one that has more keyframes as the target (G).

    With equal numbers of keyframes the first one is the target. The result's `T_target_source` is
    T_first_second in both cases.
    """
    if len(first.keyframes) >= len(second.keyframes):
        return registrar.register(first, second, T_first_second)
    start = None if T_first_second is None else se3.inverse(T_first_second)
    return registrar.register(second, first, start).inverted()
