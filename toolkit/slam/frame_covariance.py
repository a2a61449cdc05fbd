"""Covariance of a frame's pose against the map, by what it shows and by its shutter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.pose_graph.noise import pixel_covariance
from toolkit.slam.tracking.result import TrackingResult

Array = NDArray[np.float64]

# Standard deviation of directions of a pose that tracking did not determine, metres and radians.
_UNSEEN = 1.0
# Every so many rows and columns give the median depth.
_EVERY = 16


def by_view(frame: Frame, tracking: TrackingResult | None) -> Array:
    """Covariance [6, 6] of a pose by what the frame shows; 0 for the first frame of a part."""
    if tracking is None or tracking.lost:
        return np.zeros((6, 6))
    if tracking.covariance is not None:
        return tracking.covariance
    pixels = frame.camera.width * frame.camera.height
    return pixel_covariance(tracking.information, pixels, _UNSEEN)


def by_shutter(frame: Frame, velocity: Array) -> Array:
    """Covariance [6, 6] of a pose by the error of the readout time.

    Args:
        velocity: [6] (m/s, rad/s) of the camera.
    """
    depth_m = frame.depth_m[::_EVERY, ::_EVERY]
    distance_m = float(np.median(depth_m[depth_m > 0])) if depth_m.any() else 0.0
    metres, radians = np.linalg.norm(velocity[:3]), np.linalg.norm(velocity[3:])
    # In a part of the image, what a rotation displaces cannot be told from a translation.
    squares = [metres**2 + (distance_m * radians) ** 2] * 3 + [radians**2] * 3
    return frame.readout_sigma_s**2 * np.diag(squares)
