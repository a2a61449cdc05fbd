"""Estimation of the up direction from the planes of a room and a prior on the camera's attitude."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.image_sides import BORDERS, ImageSide, turned_upright

Array = NDArray[np.float64]

# Number of candidate directions; neighbours are about 3 degrees apart.
_DIRECTIONS = 4000
_KERNEL_RAD = np.radians(8.0)
# Prior of a hand-held camera: mean pitch (down), standard deviations of pitch and roll, and weight
# relative to the votes of the planes.
_PITCH_DOWN_RAD, _PITCH_RAD, _ROLL_RAD = np.radians([30.0, 30.0, 30.0])
_PRIOR_WEIGHT = 0.15
# Weight of the votes of vertical planes relative to horizontal ones.
_VERTICAL_WEIGHT = 0.9
# Planes within this angle of horizontal or vertical are used for the refinement.
_NEAR_RAD = np.radians(15.0)
# The estimate is reset if the coarse direction differs by more than this.
_CHANGE_RAD = np.radians(12.0)
_DECAY = 0.995


class UpEstimator:
    """Estimates the up direction in the map frame from the planes of all frames.

    Votes are accumulated for directions on the sphere. A plane votes for its normal (it is
    horizontal) and for all directions perpendicular to it (it is vertical). The attitude of the
    camera is a prior. The direction with the most votes is refined by least squares over the planes
    consistent with it, with exponential decay of earlier frames.

    Args:
        side: the side of the images that is up.

    Attributes:
        direction: [3] unit vector; zero before the first frame.
    """

    def __init__(self, side: ImageSide = "top") -> None:
        self.direction: Array = np.zeros(3)
        self._R_camera_turned = turned_upright(side)
        # A camera that is mounted to look straight up or down is not tilted on average.
        self._pitch_down_rad = _PITCH_DOWN_RAD if side in BORDERS else 0.0
        self._votes = np.zeros(_DIRECTIONS)
        self._scatter = np.zeros((3, 3))

    def update(self, normals: Array, fractions: Array, R_map_camera: Array) -> bool:
        """Integrate the planes of one frame.

        Args:
            normals: [N, 3] unit normals of the planes in the map frame, towards the camera.
            fractions: [N] fraction of the image that each plane covers.
            R_map_camera: [3, 3] orientation of the camera.

        Returns:
            whether the direction has changed so much that dependent estimates must be reset.
        """
        # Square roots give small planes more weight: a small part of the floor below a large wall
        # resolves the rotation about the wall's normal.
        weights = np.sqrt(fractions)
        weights /= max(1.0, float(weights.sum()))
        directions = _directions()
        self._votes = _DECAY * self._votes + _agreement(directions @ normals.T) @ weights
        pitch_down, roll = attitude(directions @ R_map_camera @ self._R_camera_turned)
        self._votes += _PRIOR_WEIGHT * _log_prior(pitch_down - self._pitch_down_rad, roll)
        coarse = directions[int(np.argmax(self._votes))]
        changed = float(self.direction @ coarse) < np.cos(_CHANGE_RAD)
        if changed:
            self.direction, self._scatter = coarse.copy(), np.zeros((3, 3))
        self._refine(normals, weights, coarse)
        return changed

    def _refine(self, normals: Array, weights: Array, coarse: Array) -> None:
        """Refine up: parallel to normals of horizontal, normal to those of vertical planes.

        See Gupta et al. 2013.
        """
        cosine = np.abs(normals @ self.direction)
        horizontal, vertical = cosine > np.cos(_NEAR_RAD), cosine < np.sin(_NEAR_RAD)
        sign = vertical.astype(float) - horizontal
        self._scatter = _DECAY * self._scatter + (normals.T * (weights * sign)) @ normals
        # A single wall does not determine up; regularise with the coarse direction.
        regularised = self._scatter - 0.02 * np.outer(coarse, coarse)
        up = np.linalg.eigh(regularised)[1][:, 0]
        up = up if up @ coarse > 0 else -up
        if up @ coarse > np.cos(_CHANGE_RAD):
            self.direction = up

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        return {
            "direction": self.direction.copy(),
            "votes": self._votes.copy(),
            "scatter": self._scatter.copy(),
        }

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.direction = np.array(arrays["direction"])
        self._votes, self._scatter = np.array(arrays["votes"]), np.array(arrays["scatter"])


@functools.cache
def _directions() -> Array:
    """Return unit vectors [K, 3] distributed uniformly over the sphere (Fibonacci spiral)."""
    number = np.arange(_DIRECTIONS) + 0.5
    polar = np.arccos(1 - 2 * number / _DIRECTIONS)
    azimuth = np.pi * (1 + 5**0.5) * number
    return np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1
    )


def _agreement(cosine: Array) -> Array:
    """Score how well planes [K, N] are horizontal or vertical for each direction, 0 to 1."""
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    horizontal = np.exp(-((angle / _KERNEL_RAD) ** 2))
    vertical = np.exp(-(((np.pi / 2 - angle) / _KERNEL_RAD) ** 2))
    return np.asarray(horizontal + _VERTICAL_WEIGHT * vertical)


def attitude(up_camera: Array) -> tuple[Array, Array]:
    """Return pitch (down) and roll [K] of a camera by the direction up [K, 3] in its coordinates.

    Both are in radians, and 0 if the top of the image is up.
    """
    pitch_down = np.arcsin(np.clip(-up_camera[:, 2], -1.0, 1.0))
    roll = np.arctan2(up_camera[:, 0], -up_camera[:, 1])
    # Roll is undefined for a camera that looks straight up or down.
    return pitch_down, np.where(np.cos(pitch_down) > 0.05, roll, 0.0)


def _log_prior(pitch: Array, roll: Array) -> Array:
    """Return the log prior [K] of deviations of pitch and roll in radians; its maximum is 0."""
    return np.asarray(-0.5 * (pitch / _PITCH_RAD) ** 2 - 0.5 * (roll / _ROLL_RAD) ** 2)
