"""Bundle adjustment in NumPy: the reference of the C++ kernel, for machines without a compiler."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.depth.monocular.bundle_adjustment.problem import (
    BundleOptions,
    BundleProblem,
    BundleResult,
)

Array = NDArray[np.float64]

# See bundle_adjustment.cpp.
_BEHIND_PX = 1e3
_MIN_COSINE = 1e-3
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e-9, 1e8
_TINY = 1e-12
_GAUGE_DAMPING = 1e-8


class _Parameters:
    """A point in the space of all unknowns."""

    def __init__(self, T_camera_world: Array, inverse_depth: Array, log_focal: float) -> None:
        self.T_camera_world, self.inverse_depth = T_camera_world, inverse_depth
        self.log_focal = log_focal

    def moved(self, step: Array, places: Array, inverse_depth: Array, focal: bool) -> _Parameters:
        T = self.T_camera_world.copy()
        for p, place in enumerate(places):
            if place >= 0:
                T[p] = se3.orthonormalise(se3.exp(step[place : place + 6]) @ T[p])
        log_focal = self.log_focal + float(step[-1]) if focal else self.log_focal
        return _Parameters(T, inverse_depth, log_focal)


def adjust(problem: BundleProblem, options: BundleOptions) -> BundleResult:
    """See `toolkit.depth.monocular.bundle_adjustment.solver.adjust`."""
    T_camera_world = se3.inverse(problem.T_world_camera)
    now = _Parameters(T_camera_world, problem.landmarks.inverse_depth.astype(np.float64), 0.0)
    places = np.where(problem.fixed, -1, 6 * (np.cumsum(~problem.fixed) - 1))
    before = cost = _cost(problem, options, now)[0]
    damping, iterations, converged = _FIRST_DAMPING, 0, False
    while iterations < options.iterations and not converged:
        iterations += 1
        system = _linearise(problem, options, now, places)
        better = False
        while not better and damping < _MAX_DAMPING:
            step = _step(system, damping)
            if step is not None:
                moved = np.maximum(now.inverse_depth + step[1], options.min_inverse_depth)
                after = now.moved(step[0], places, moved, options.focal)
                new_cost = _cost(problem, options, after)[0]
                better = new_cost < cost
            if better:
                converged = cost - new_cost < options.min_decrease * cost
                now, cost, damping = after, new_cost, max(damping / 10, _MIN_DAMPING)
            else:
                damping *= 10
        converged = converged or not better
    T_world_camera = se3.inverse(now.T_camera_world)
    T_world_camera[problem.fixed] = problem.T_world_camera[problem.fixed]
    return BundleResult(
        T_world_camera,
        now.inverse_depth,
        _cost(problem, options, now)[1],
        before,
        cost,
        math.exp(now.log_focal),
        _focal_sigma(_linearise(problem, options, now, places)) if options.focal else 0.0,
        iterations,
        converged,
    )


class _System:
    """Normal equations: H [n, n] and g [n] of poses and focal length, those of the landmarks
    (depth_H, depth_g [L]), and the coupling [L, n] of both."""

    def __init__(self, size: int, landmarks: int) -> None:
        self.H, self.g = np.zeros((size, size)), np.zeros(size)
        self.depth_H, self.depth_g = np.zeros(landmarks), np.zeros(landmarks)
        self.coupling = np.zeros((landmarks, size))


def _points(problem: BundleProblem, at: _Parameters) -> tuple[Array, Array, Array, Array]:
    """Rays [O, 3], rotations [O, 3, 3] and translations [O, 3] from the anchors, points [O, 3]."""
    marks, seen, camera = problem.landmarks, problem.observations, problem.camera
    factor = math.exp(at.log_focal)
    ray = np.ones((len(seen), 3))
    centred = marks.anchor_px[seen.landmark] - [camera.cx, camera.cy]
    ray[:, :2] = centred / (factor * np.array([camera.fx, camera.fy]))
    T_world_anchor = se3.inverse(at.T_camera_world[marks.anchor[seen.landmark]])
    T = at.T_camera_world[seen.pose] @ T_world_anchor
    R, t = T[:, :3, :3], T[:, :3, 3]
    q = at.inverse_depth[seen.landmark]
    return ray, R, t, np.einsum("nij,nj->ni", R, ray) + q[:, None] * t


def _residuals(
    problem: BundleProblem, at: _Parameters, points: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Residuals [O, 2], distances [O], and whether the points are in front of the camera."""
    camera, factor = problem.camera, math.exp(at.log_focal)
    in_front = points[:, 2] > _MIN_COSINE
    z = np.where(in_front, points[:, 2], 1.0)
    focal = factor * np.array([camera.fx, camera.fy])
    px = focal * points[:, :2] / z[:, None] + [camera.cx, camera.cy]
    r = np.where(in_front[:, None], px - problem.observations.px, 0.0)
    return r, np.where(in_front, np.hypot(r[:, 0], r[:, 1]), _BEHIND_PX), in_front


def _cost(problem: BundleProblem, options: BundleOptions, at: _Parameters) -> tuple[float, Array]:
    distance = _residuals(problem, at, _points(problem, at)[3])[1]
    huber = options.huber_px
    linear = huber * (distance - 0.5 * huber)
    expected, information = problem.landmarks.prior.T
    off = at.inverse_depth - expected
    cost = np.where(distance <= huber, 0.5 * distance**2, linear).sum()
    return float(cost + 0.5 * (information * off**2).sum()), distance


def _linearise(
    problem: BundleProblem, options: BundleOptions, at: _Parameters, places: Array
) -> _System:
    marks, seen, camera = problem.landmarks, problem.observations, problem.camera
    size = 6 * int((~problem.fixed).sum()) + options.focal
    system = _System(size, len(marks))
    expected, information = marks.prior.T
    system.depth_H += information
    system.depth_g -= information * (at.inverse_depth - expected)
    ray, R, t, Y = _points(problem, at)
    r, distance, in_front = _residuals(problem, at, Y)
    focal = math.exp(at.log_focal) * np.array([camera.fx, camera.fy])
    weight = np.minimum(1.0, options.huber_px / np.maximum(distance, 1e-12)) * in_front
    for o in np.flatnonzero(in_front):
        x, y = Y[o, :2] / Y[o, 2]
        P = np.array([[focal[0], 0.0, -focal[0] * x], [0.0, focal[1], -focal[1] * y]]) / Y[o, 2]
        q, mark = at.inverse_depth[seen.landmark[o]], seen.landmark[o]
        J = np.zeros((2, size))
        place, anchor = places[seen.pose[o]], places[marks.anchor[mark]]
        if place >= 0:
            J[:, place : place + 6] = np.hstack([q * P, -P @ se3.hat(Y[o])])
        if anchor >= 0:
            own = np.hstack([-q * P @ R[o], P @ R[o] @ se3.hat(ray[o])])
            J[:, anchor : anchor + 6] += own
        if options.focal:
            J[:, -1] = focal * [x, y] - P @ R[o][:, :2] @ ray[o, :2]
        by_depth = P @ t[o]
        system.H += weight[o] * J.T @ J
        system.g -= weight[o] * J.T @ r[o]
        system.depth_H[mark] += weight[o] * by_depth @ by_depth
        system.depth_g[mark] -= weight[o] * by_depth @ r[o]
        system.coupling[mark] += weight[o] * by_depth @ J
    return system


def _reduced(system: _System, damping: float) -> tuple[Array, Array, Array]:
    """Equations of poses and focal length alone, and the inverses [L] of the landmarks' terms."""
    inverse = 1.0 / (system.depth_H * (1.0 + damping) + _TINY)
    diagonal = np.diag(damping * np.diag(system.H) + _TINY)
    scaled = system.coupling * inverse[:, None]
    H = system.H + diagonal - scaled.T @ system.coupling
    return H, system.g - scaled.T @ system.depth_g, inverse


def _step(system: _System, damping: float) -> tuple[Array, Array] | None:
    """Changes of poses and focal length [n] and of inverse depths [L]; None if not definite."""
    H, g, inverse = _reduced(system, damping)
    try:
        np.linalg.cholesky(H)
    except np.linalg.LinAlgError:
        return None
    step = np.asarray(np.linalg.solve(H, g), np.float64)
    return step, inverse * (system.depth_g - system.coupling @ step)


def _focal_sigma(system: _System) -> float:
    H, _, _ = _reduced(system, _GAUGE_DAMPING)
    try:
        information = float(np.linalg.cholesky(H)[-1, -1]) ** 2
    except np.linalg.LinAlgError:
        return math.inf
    return 1.0 / math.sqrt(information)
