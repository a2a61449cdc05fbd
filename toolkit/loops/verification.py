"""Verification of a registration before it becomes a loop edge of the pose graph.

Two submaps are accepted as the same place if enough of one lies on the surface of the other with
the same colours and classes. Two identical rooms pass these tests; only odometry can distinguish
them, which `pose_graph.consistency` checks.
"""

from __future__ import annotations

import numpy as np

from toolkit.loops.options import VerificationOptions
from toolkit.loops.registration.result import RegistrationResult


def rejection_reason(result: RegistrationResult, options: VerificationOptions) -> str:
    """Return why a registration is rejected as a loop; empty if it passes."""
    if not result.converged:
        return result.reason or "registration did not converge"
    if result.overlap < options.min_overlap:
        return f"only {100 * result.overlap:.0f} % overlap"
    if result.inliers < options.min_inliers:
        return f"only {100 * result.inliers:.0f} % inliers in the overlap"
    # Without semantics the agreement is NaN and this comparison is false.
    if result.class_agreement < options.min_class_agreement:
        return f"classes agree in only {100 * result.class_agreement:.0f} % of the overlap"
    if not result.residual.depth_m <= options.max_depth_residual_m:
        return f"depth residual of {100 * result.residual.depth_m:.1f} cm at 1 m"
    if not result.residual.intensity <= options.max_intensity_residual:
        return f"intensity residual of {result.residual.intensity:.2f}"
    weakest = float(np.linalg.eigvalsh(result.information)[0])
    if not weakest > options.min_information:
        return f"the overlap does not constrain the motion (information {weakest:.1e})"
    return ""
