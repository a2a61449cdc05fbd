"""What an alignment determines: the rise of its cost beside the pose, direction by direction.

The normal equations count every gradient of the model as a measurement, those of its noise and
blur, too: along a wall without texture they claim millimetres. The cost itself does not rise there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import STUDENT_T_DOF
from toolkit.splatting.alignment.backend import linearise
from toolkit.splatting.alignment.data import LevelProblem
from toolkit.splatting.alignment.gauss_newton import GAIN, add_exposure_prior
from toolkit.splatting.alignment.similarity import sampled

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# The displacements at which the cost is measured: 5 cm or 2 degrees.
UNITS = np.array([0.05, 0.05, 0.05, 0.035, 0.035, 0.035])
# Relative rise of the cost at one unit from which a direction is determined well, so that stronger
# ones need not be measured.
_WELL = 0.3
# Relative rise where the view determines nothing: up to 0.04 along stripes, where residuals are
# those of noise. Larger ones than this have other causes, and chance changes their sum by less.
_CHANCE, _NOISE_INTENSITY = 0.04, 0.015
# Relative rise that the errors of pixels and of the map hide.
_NOISE = 0.001
# Up to this rise, what it is beside the other directions is measured, in at most so many steps, the
# last of which reduces it by less than a fraction.
_STEEP, _STEPS, _CONVERGED = 1.0, 8, 0.01
_WEAK = 1e-6

# Every so many rows and columns are used where derivatives are computed, and the pixels that they
# are computed from.
_STEP, _AROUND = 2, np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Determinacy:
    """How well an alignment determines each direction.

    Attributes:
        directions: [6, 6] rows, displacements x in exp(x) T_model_frame of one unit, from the one
            that the alignment determines least.
        rises: [6] relative rise of the cost at each, the smaller one of both signs, at least 0;
            those of well determined directions follow from the normal equations.
    """

    directions: Array
    rises: Array

    def in_frame(self, T_model_frame: Array) -> Array:
        """Information [6, 6] of x in T_model_frame exp(x)."""
        duals = np.linalg.solve(self.directions.T, se3.adjoint(T_model_frame))
        return np.asarray((duals.T * (self.rises / _NOISE)) @ duals)


def determinacy(problem: LevelProblem, refit: bool = False) -> Determinacy:
    """Measure what an alignment determines.

    Where the map ends or its stripes are slightly bent, a displacement raises the cost because
    the rest of the pose does not fit any more, and nothing else determines it.

    Args:
        problem: at its aligned pose.
        refit: align the rest of the pose at each displacement; otherwise rises are upper limits.
    """
    here = linearise(problem)
    H = _curvature(problem)
    if not np.isfinite(here.cost) or not np.isfinite(H).all():
        return Determinacy(np.diag(UNITS), np.zeros(6))
    strengths, axes = np.linalg.eigh(H * np.outer(UNITS, UNITS))
    chance = _CHANCE * min(1.0, _NOISE_INTENSITY / problem.scales.intensity) ** 2
    directions, rises = (UNITS[:, None] * axes).T, np.zeros(6)
    for k in range(len(directions)):
        rise = _rise(problem, here.cost, directions[k])
        if refit and rise < _STEEP:
            # A direction that was measured before would lead back to it.
            directions[k], rise = _valley(problem, here.cost, directions[k], directions[k + 1 :])
        rises[k] = max(rise - chance, 0.0)
        if k > 0 and rises[k] > _WELL:
            rises[k + 1 :] = rises[k] * strengths[k + 1 :] / max(strengths[k], 1e-9)
            break
    return Determinacy(directions, rises)


def _curvature(problem: LevelProblem) -> Array:
    """Second derivative [6, 6] of the cost by x in exp(x) T_model_frame, without that of noise.

    The normal equations square the derivatives of the model, and with them those of its noise: the
    pixels along stripes seem to determine the motion along them. The noise of the frame is another
    one, so that the products of the derivatives of both have no such part (as with instrumental
    variables).
    """
    scales, exposure, T = problem.scales, problem.exposure, problem.T_model_frame
    own = problem.frame.intensity.cpu().numpy() * np.float32(exposure.gain)
    z = problem.frame.depth_m.cpu().numpy()
    _, view_m, view = sampled(problem.model, problem.frame.camera, z, T)
    known = cv2.erode((view_m > 0).astype(np.uint8), _AROUND)[::_STEP, ::_STEP] > 0
    points = _points(problem.frame.camera, z)[:, known]
    first, second = (
        _derivatives(image, problem.frame.camera, points, known) for image in (view, own)
    )
    residual = (view - own - np.float32(exposure.bias))[::_STEP, ::_STEP][known] / scales.intensity
    robust = (STUDENT_T_DOF + 1.0) / (STUDENT_T_DOF + residual**2) / scales.intensity**2
    H = _STEP**2 * scales.photometric_weight * (first * robust) @ second.T
    A = se3.adjoint(se3.inverse(T))
    depth = linearise(replace(problem, scales=replace(scales, photometric_weight=0.0))).H[:6, :6]
    return np.asarray(depth + A.T @ (0.5 * (H + H.T)) @ A)


def _points(camera: Camera, depth_m: Image) -> Image:
    """Points [3, h, w] of every n-th row and column of a depth image [H, W]."""
    z = depth_m[::_STEP, ::_STEP]
    x = ((np.arange(0, camera.width, _STEP) - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(0, camera.height, _STEP) - camera.cy) / camera.fy).astype(np.float32)
    return np.stack([x * z, y[:, None] * z, z])


def _derivatives(image: Image, camera: Camera, points: Image, known: NDArray[np.bool_]) -> Image:
    """Derivatives [6, N] of an image [H, W] by the motion of points [3, N] in front of a camera.

    Args:
        known: of every n-th row and column, which the points belong to.
    """
    (x, y, z), kernel = points, np.array([[-0.5, 0.0, 0.5]])
    a, b = (
        cv2.filter2D(image, -1, focal * k)[::_STEP, ::_STEP][known] / z
        for focal, k in ((camera.fx, kernel), (camera.fy, kernel.T))
    )
    c = -(a * x + b * y) / z
    return np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])


def _rise(problem: LevelProblem, cost: float, direction: Array) -> float:
    """Relative rise of the cost that a displacement [6] causes, of the sign that causes less.

    Alignment ends in a minimum of the noise if there is no other. Its cost rises beside it, too,
    but does not go on rising.
    """
    near = _least_rise(problem, cost, direction)
    if near > _WELL:
        return near
    return max(min(near, _least_rise(problem, cost, 2.0 * direction) - near), 0.0)


def _least_rise(problem: LevelProblem, cost: float, direction: Array) -> float:
    poses = (se3.exp(sign * direction) @ problem.T_model_frame for sign in (-1.0, 1.0))
    costs = [linearise(replace(problem, T_model_frame=T)).cost for T in poses]
    return min(costs) / max(cost, 1e-9) - 1.0


def _valley(
    problem: LevelProblem, cost: float, direction: Array, others: Array
) -> tuple[Array, float]:
    """The displacement [6] along which the cost rises least, and its rise, as of `_rise`.

    Args:
        direction: [6] the displacement that is kept. others: [N, 6] those that may be added.
    """
    ends = [_refitted(problem, sign * direction, others) for sign in (-1.0, 1.0)]
    sign = -1.0 if ends[0][1] < ends[1][1] else 1.0
    found, least = min(ends, key=lambda end: end[1])
    near = least / max(cost, 1e-9) - 1.0
    if near <= _WELL:
        far = min(_refitted(problem, twice * found, others)[1] for twice in (-2.0, 2.0))
        near = min(near, far / max(cost, 1e-9) - 1.0 - near)
    return sign * found, max(near, 0.0)


def _refitted(problem: LevelProblem, displacement: Array, others: Array) -> tuple[Array, float]:
    """The displacement [6] of least cost that others [N, 6] lead to, and its cost.

    The exposure is fitted, too: along a wall that is darker towards its foot, a motion and a change
    of exposure are the same.
    """
    x, best, count = displacement, np.inf, len(others)
    change, basis = np.zeros(2), np.zeros((count + 2, 8))
    basis[:count, :6], basis[count:, GAIN:] = others, np.eye(2)
    for _ in range(_STEPS):
        T = se3.exp(x) @ problem.T_model_frame
        exposure = Exposure(problem.exposure.gain + change[0], problem.exposure.bias + change[1])
        linear = linearise(replace(problem, T_model_frame=T, exposure=exposure))
        if not linear.cost < (1.0 - _CONVERGED) * best:
            break
        displacement, best = x, linear.cost
        information = linear.intensity_pixels / problem.scales.intensity**2
        add_exposure_prior(linear.H, linear.g, information, change)
        H, g = basis @ linear.H @ basis.T, basis @ linear.g
        step = -np.linalg.solve(H + _WEAK * np.eye(len(g)), g)
        x, change = se3.log(se3.exp(step[:count] @ others) @ se3.exp(x)), change + step[count:]
    return displacement, best
