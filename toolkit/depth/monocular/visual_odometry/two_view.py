"""Relative motion of two images from matched points: pure rotation, or rotation and translation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera

Array = NDArray[np.float64]

_ROTATION_ITERATIONS = 10
# A rotation explains matches within this error, relative to the image's width.
_INLIER = 1.0 / 320.0
_CONFIDENCE = 0.9999
_RANSAC_ITERATIONS = 2000


def rays(camera: Camera, px: Array) -> Array:
    """Directions [N, 3] with z = 1 of pixels [N, 2]."""
    x = (px[:, 0] - camera.cx) / camera.fx
    y = (px[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(px))], 1)


def fit_rotation(camera: Camera, first_px: Array, second_px: Array) -> tuple[Array, Array]:
    """Rotation that maps the rays of one image best to those of another (robust Kabsch).

    Returns:
        R_second_first [3, 3] and the distances [N] in pixels that remain.
    """
    first, second = rays(camera, first_px), rays(camera, second_px)
    unit_first = first / np.linalg.norm(first, axis=1, keepdims=True)
    unit_second = second / np.linalg.norm(second, axis=1, keepdims=True)
    weights = np.ones(len(first))
    scale = camera.width * _INLIER
    for _ in range(_ROTATION_ITERATIONS):
        U, _, Vt = np.linalg.svd((unit_second * weights[:, None]).T @ unit_first)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        error = np.linalg.norm(camera.project(first @ R.T) - second_px, axis=1)
        weights = 1.0 / (1.0 + (error / scale) ** 2)
    return R, error


@dataclass(frozen=True)
class TwoView:
    """Relative motion of two images with parallax.

    Attributes:
        T_second_first: [4, 4], with a translation of length 1.
        inlier: [N] which matches it explains.
    """

    T_second_first: Array
    inlier: NDArray[np.bool_]


def relative_motion(camera: Camera, first_px: Array, second_px: Array) -> TwoView | None:
    """Motion between two images from matched pixels [N, 2]; None if it cannot be estimated."""
    K = camera.matrix
    E, mask = cv2.findEssentialMat(
        first_px, second_px, K, cv2.USAC_MAGSAC, _CONFIDENCE, 1.0, _RANSAC_ITERATIONS
    )
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, mask = cv2.recoverPose(E, first_px, second_px, K, mask=mask)
    if count < 8:
        return None
    T = se3.from_rotation_translation(R, t.ravel() / np.linalg.norm(t))
    return TwoView(T, mask.ravel().astype(bool))


def triangulate(camera: Camera, T_second_first: Array, first_px: Array, second_px: Array) -> Array:
    """Inverse depths [N] in the first image that bring points closest to the second image's rays.

    Linear in the inverse depth; not positive where the rays diverge.

    Args:
        T_second_first: [4, 4] or [N, 4, 4].
    """
    T = np.broadcast_to(T_second_first, (len(first_px), 4, 4))
    turned = np.einsum("nij,nj->ni", T[:, :3, :3], rays(camera, first_px))
    numerator, denominator = depth_equations(turned, T[:, :3, 3], rays(camera, second_px))
    return numerator / np.maximum(denominator, 1e-18)


def depth_equations(turned: Array, t: Array, second: Array) -> tuple[Array, Array]:
    """Normal equations of inverse depths q [N], for which turned + q t is closest to a ray.

    Args:
        turned: [N, 3] rays of the first image in the second camera.
        t: [3] or [N, 3] position of the first camera in the second one.
        second: [N, 3] rays of the second image.

    Returns:
        [N] and [N], of which q is the ratio; sums over images give q from all of them.
    """
    # Both components of the projection onto the second ray are linear in q.
    a = t[..., :2] - second[:, :2] * t[..., 2:]
    b = second[:, :2] * turned[:, 2:] - turned[:, :2]
    return (a * b).sum(1), (a * a).sum(1)


def parallax_rad(camera: Camera, R_second_first: Array, first_px: Array, second_px: Array) -> Array:
    """Angles [N] between the rays of matched pixels after a rotation is undone.

    Args:
        R_second_first: [3, 3] or [N, 3, 3].
    """
    R = np.broadcast_to(R_second_first, (len(first_px), 3, 3))
    first = np.einsum("nij,nj->ni", R, rays(camera, first_px))
    second = rays(camera, second_px)
    cosine = (first * second).sum(1)
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(sine, cosine)
