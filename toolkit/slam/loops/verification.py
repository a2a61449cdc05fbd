"""Verification of a registration before it becomes a loop edge of the pose graph.

Two submaps are accepted as the same place if enough of one lies on the surface of the other with
the same colours and classes. Two identical rooms pass these tests; only odometry can distinguish
them, which `pose_graph.consistency` checks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toolkit.slam.loops.registration.result import RegistrationResult


@dataclass(frozen=True)
class VerificationLimits:
    """Limits that the registration of two submaps must keep to become a loop.

    Attributes:
        min_overlap: minimum fraction of the source's pixels that the target also shows. Of
            RedKitchen's pairs, those below were up to 12 cm off the ground truth, those above 5 cm.
        min_inliers: minimum fraction of the overlapping pixels whose surfaces agree.
        min_class_agreement: minimum fraction of the agreeing pixels that have the same class, where
            both have one.
        max_intensity_residual: maximum robust scale of the photometric residuals, for intensities
            in [0, 1].
        max_depth_residual_m: maximum robust scale of the depth residuals at a depth of 1 m.
        min_information: minimum eigenvalue of the information matrix, in 1/m^2 and 1/rad^2.
    """

    min_overlap: float = 0.4
    min_inliers: float = 0.8
    min_class_agreement: float = 0.7
    max_intensity_residual: float = 0.1
    max_depth_residual_m: float = 0.02
    min_information: float = 1e4


def rejection_reason(
    result: RegistrationResult, limits: VerificationLimits | None = VerificationLimits()
) -> str:
    """Return why a registration is rejected as a loop; empty if it passes.

    Args:
        limits: None accepts every registration that has converged.
    """
    if not result.converged:
        return result.reason or "registration did not converge"
    if limits is None:
        return ""
    if result.overlap < limits.min_overlap:
        return f"only {100 * result.overlap:.0f} % overlap"
    if result.inliers < limits.min_inliers:
        return f"only {100 * result.inliers:.0f} % inliers in the overlap"
    # Without semantics the agreement is NaN and this comparison is false.
    if result.class_agreement < limits.min_class_agreement:
        return f"classes agree in only {100 * result.class_agreement:.0f} % of the overlap"
    if not result.residual.depth_m <= limits.max_depth_residual_m:
        return f"depth residual of {100 * result.residual.depth_m:.1f} cm at 1 m"
    if not result.residual.intensity <= limits.max_intensity_residual:
        return f"intensity residual of {result.residual.intensity:.2f}"
    weakest = float(np.linalg.eigvalsh(result.information)[0])
    if not weakest > limits.min_information:
        return f"the overlap does not constrain the motion (information {weakest:.1e})"
    return ""
