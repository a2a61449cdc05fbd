"""Whether a registration is a loop: what must hold before an edge enters the graph.

A descriptor only suspects. Two submaps are taken for one place when enough of one lies on the
surface of the other, in the same colours and of the same classes. Two identical rooms pass all
of that; what tells them apart is the odometry, which `pose_graph.consistency` asks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toolkit.registration.result import RegistrationResult


@dataclass(frozen=True)
class VerificationOptions:
    """Bounds of a loop.

    Attributes:
        min_overlap: share of the source's pixels, from the views compared, that the target
            shows as well.
        min_inliers: share of those whose surfaces agree.
        min_class_agreement: share of those, with a class on both sides, of the same class.
        max_intensity_residual: robust scale of the photometric residual, intensities in [0, 1].
        max_depth_residual_m: robust scale of the geometric residual at 1 m, metres.
        min_information: smallest eigenvalue of the information matrix (1 / m^2, 1 / rad^2).
    """

    min_overlap: float = 0.3
    min_inliers: float = 0.8
    min_class_agreement: float = 0.7
    max_intensity_residual: float = 0.1
    max_depth_residual_m: float = 0.02
    min_information: float = 1e4


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
