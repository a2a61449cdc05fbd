"""Whether a registration is a loop: what must hold before an edge enters the graph.

A descriptor only suspects. Two submaps are taken for one place when enough of one lies on the
surface of the other, in the same colours and of the same classes. Two identical rooms pass all
of that; what tells them apart is the odometry, which `pose_graph.consistency` asks.
"""

from __future__ import annotations

import numpy as np

from toolkit.loops.options import VerificationOptions
from toolkit.registration.result import RegistrationResult


def objection(result: RegistrationResult, options: VerificationOptions) -> str:
    """Why a registration is no loop, in plain words; empty where it may be one."""
    if not result.converged:
        return result.reason or "registration did not converge"
    if result.overlap < options.min_overlap:
        return f"only {100 * result.overlap:.0f} % overlap"
    if result.inliers < options.min_inliers:
        return f"surfaces agree on {100 * result.inliers:.0f} % of the overlap alone"
    # Without semantics the agreement is nan, and nothing speaks against the loop.
    if result.class_agreement < options.min_class_agreement:
        return f"classes agree on {100 * result.class_agreement:.0f} % of it alone"
    if not result.residual.depth_m <= options.max_depth_residual_m:
        return f"depth disagrees by {100 * result.residual.depth_m:.1f} cm at 1 m"
    if not result.residual.intensity <= options.max_intensity_residual:
        return f"intensity disagrees by {result.residual.intensity:.2f}"
    weakest = float(np.linalg.eigvalsh(result.information)[0])
    if not weakest > options.min_information:
        return f"the overlap does not fix the motion (information {weakest:.1e})"
    return ""
