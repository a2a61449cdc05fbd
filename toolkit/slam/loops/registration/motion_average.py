"""Robust average of many hypotheses of one rigid motion, some of them wrong.

The residuals are those of G-5, `log((T_target_camera_i)^-1 T T_source_camera_i)`. They are computed
in camera coordinates. In those of the submaps, a small rotation error would cause a large
translation error far from the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3

Array = NDArray[np.float64]

# Standard deviations of a hypothesis's translation and rotation.
SIGMA_M, SIGMA_RAD = 0.03, 0.02
_UNITS = np.repeat([SIGMA_M, SIGMA_RAD], 3)
_ITERATIONS = 30
# Geman-McClure scale: squared residual (in squared standard deviations) at which the weight is 1/4.
_SCALE = 9.0
_MIN_STEP = 1e-8


@dataclass(frozen=True)
class MotionAverage:
    """The robust mean of several hypotheses of one motion.

    Attributes:
        T_target_source: [4, 4].
        weights: [K] robust weight of each hypothesis, in [0, 1].
        inliers: [K] bool, hypotheses within the tolerance.
        information: [6, 6] of x in T_target_source exp(x).
    """

    T_target_source: Array
    weights: Array
    inliers: NDArray[np.bool_]
    information: Array
    iterations: int
    converged: bool


def average_motion(
    T_target_camera: Array,
    T_source_camera: Array,
    start: Array | None = None,
    agree_within: float = 4.0,
) -> MotionAverage:
    """The T with T T_source_camera_i closest to T_target_camera_i, robustly (G-5).

    Gauss-Newton with Geman-McClure weights. It starts at the hypothesis with the lowest cost, so
    that no initial value is needed and a majority of wrong hypotheses that differ from each other
    does not matter.

    Args:
        T_target_camera, T_source_camera: [K, 4, 4], K > 0.
        start: [4, 4], a further initial value.
        agree_within: maximum residual of an inlier, in standard deviations.
    """
    hypotheses = [a @ se3.inverse(b) for a, b in zip(T_target_camera, T_source_camera, strict=True)]
    starts = hypotheses if start is None else [*hypotheses, start]
    costs = [_cost(_residuals(T, T_target_camera, T_source_camera)) for T in starts]
    T = starts[int(np.argmin(costs))]
    to_camera = [se3.adjoint(se3.inverse(T_sc)) for T_sc in T_source_camera]
    converged, steps = False, 0
    while True:
        residuals = _residuals(T, T_target_camera, T_source_camera)
        weights = _weights(residuals)
        # log(E exp(Ad x)) = log(E) + J(log E) Ad x, in the residuals' units.
        J = [
            _inverse_right_jacobian(r * _UNITS) @ A / _UNITS[:, None]
            for r, A in zip(residuals, to_camera, strict=True)
        ]
        H = sum(w * j.T @ j for w, j in zip(weights, J, strict=True))
        if converged or steps == _ITERATIONS:
            break
        g = sum(w * j.T @ r for w, j, r in zip(weights, J, residuals, strict=True))
        step = -np.linalg.lstsq(H, g, rcond=None)[0]
        T = se3.orthonormalise(T @ se3.exp(step))
        steps += 1
        converged = bool(np.linalg.norm(step) < _MIN_STEP)
    inliers = np.linalg.norm(residuals, axis=1) < agree_within
    return MotionAverage(T, weights, inliers, np.asarray(H), steps, converged)


def _residuals(T: Array, T_target_camera: Array, T_source_camera: Array) -> Array:
    """[K, 6] in units of the sigmas."""
    found = se3.inverse(T_target_camera) @ T @ T_source_camera
    return np.array([se3.log(E) for E in found]) / _UNITS


def _cost(residuals: Array) -> float:
    squares = (residuals**2).sum(axis=1)
    return float((squares / (1.0 + squares / _SCALE)).sum())


def _weights(residuals: Array) -> Array:
    squares = (residuals**2).sum(axis=1)
    return 1.0 / (1.0 + squares / _SCALE) ** 2


def _inverse_right_jacobian(tangent: Array) -> Array:
    """Jr^-1 [6, 6] of SE(3) at a tangent, by its series; accurate to 1e-6 up to one radian."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = se3.hat(tangent[3:])
    ad[:3, 3:] = se3.hat(tangent[:3])
    square = ad @ ad
    fourth = square @ square
    return np.eye(6) + ad / 2.0 + square / 12.0 - fourth / 720.0 + fourth @ square / 30240.0
