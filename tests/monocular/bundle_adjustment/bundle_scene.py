"""A bundle adjustment whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.bundle_adjustment.problem import BundleProblem, Landmarks, Observations

CAMERA = Camera(300.0, 310.0, 160.0, 120.0, 320, 240)


def scene(poses: int = 5, landmarks: int = 60, noise_px: float = 0.0) -> BundleProblem:
    """Points in front of a moving camera, seen in all images; everything is at its true value.

    Args:
        noise_px: standard deviation of the image points outside the anchors.
    """
    rng = np.random.default_rng(5)
    T = np.array(
        [se3.exp([0.1 * n, 0.02 * n * n, 0.05 * n, 0.0, 0.03 * n, 0.01 * n]) for n in range(poses)]
    )
    anchor = rng.integers(0, 2, landmarks).astype(np.int32)
    px = rng.uniform([20, 20], [300, 220], (landmarks, 2))
    inverse_depth = rng.uniform(0.2, 0.8, landmarks)
    rays = np.ones((landmarks, 3))
    rays[:, :2] = (px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    local = rays / inverse_depth[:, None]
    points = np.einsum("nij,nj->ni", T[anchor][:, :3, :3], local) + T[anchor][:, :3, 3]
    mark, pose, seen = [], [], []
    for n in range(landmarks):
        for p in range(poses):
            if p != anchor[n]:
                mark.append(n)
                pose.append(p)
                seen.append(CAMERA.project(se3.transform_points(se3.inverse(T[p]), points[n])))
    fixed = np.arange(poses) < 2
    observed = np.array(seen) + rng.normal(0.0, noise_px, (len(seen), 2))
    return BundleProblem(
        CAMERA,
        T,
        fixed,
        Landmarks(anchor, px, inverse_depth, np.zeros((landmarks, 2))),
        Observations(np.array(mark, np.int32), np.array(pose, np.int32), observed),
    )


def disturbed(problem: BundleProblem, size: float = 1.0) -> BundleProblem:
    """The same observations, from wrong initial poses and inverse depths."""
    rng = np.random.default_rng(6)
    T = problem.T_world_camera.copy()
    for p in np.flatnonzero(~problem.fixed):
        T[p] = T[p] @ se3.exp(size * rng.normal(0.0, 0.02, 6))
    marks = problem.landmarks
    wrong = marks.inverse_depth * np.exp(size * rng.normal(0.0, 0.1, len(marks)))
    return replace(problem, T_world_camera=T, landmarks=replace(marks, inverse_depth=wrong))
