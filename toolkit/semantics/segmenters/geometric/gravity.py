"""Which way is up: from the planes that a room is made of, and from how cameras are held."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Directions in which up is looked for; neighbours are about 3 degrees apart.
_DIRECTIONS = 4000
_KERNEL_RAD = np.radians(8.0)
# A hand-held camera looks a little down and is roughly upright: its likely pitch, and how far
# pitch and roll stray. Against what planes say, habit has this weight.
_PITCH_DOWN_RAD, _PITCH_RAD, _ROLL_RAD = np.radians([30.0, 30.0, 30.0])
_HABIT = 0.15
# A plane that could be either is more often level.
_UPRIGHT = 0.9
# Planes within this angle of level or upright take part in the fine estimate.
_NEAR_RAD = np.radians(15.0)
# A better direction farther away than this is a change of mind.
_CHANGE_RAD = np.radians(12.0)
_FORGET = 0.995


class UpEstimator:
    """Up in the map's frame, from the planes of frame after frame.

    Votes are collected for directions all over the sphere: a plane speaks for its own normal
    (it is level) and for all directions at right angles to it (it is upright), and the
    camera for its own upper side. The direction with the most votes is then refined by least
    squares over the planes that agree with it, remembered with slow forgetting.

    Attributes:
        direction: up [3], a unit vector; zero before the first frame.
    """

    def __init__(self) -> None:
        self.direction: Array = np.zeros(3)
        self._votes = np.zeros(_DIRECTIONS)
        self._scatter = np.zeros((3, 3))

    def update(self, normals: Array, shares: Array, R_map_camera: Array) -> bool:
        """Take in the planes of one frame.

        Args:
            normals: [N, 3] of planes, in the map's frame, unit length, towards the camera.
            shares: [N] of the image that each covers.
            R_map_camera: [3, 3] the camera's orientation.

        Returns:
            whether up has changed so much that what was built on it is void.
        """
        # Roots, since a strip of floor below a large wall decides which way that wall stands.
        weights = np.sqrt(shares)
        weights /= max(1.0, float(weights.sum()))
        directions = _directions()
        self._votes = _FORGET * self._votes + _agreement(directions @ normals.T) @ weights
        self._votes += _HABIT * _habit(directions @ R_map_camera)
        coarse = directions[int(np.argmax(self._votes))]
        changed = float(self.direction @ coarse) < np.cos(_CHANGE_RAD)
        if changed:
            self.direction, self._scatter = coarse.copy(), np.zeros((3, 3))
        self._refine(normals, weights, coarse)
        return changed

    def _refine(self, normals: Array, weights: Array, coarse: Array) -> None:
        """Up is where level planes point and upright ones do not (Gupta et al. 2013)."""
        cosine = np.abs(normals @ self.direction)
        level, upright = cosine > np.cos(_NEAR_RAD), cosine < np.sin(_NEAR_RAD)
        sign = upright.astype(float) - level
        self._scatter = _FORGET * self._scatter + (normals.T * (weights * sign)) @ normals
        # One wall alone leaves up free to turn in it: then the coarse answer holds it.
        held = self._scatter - 0.02 * np.outer(coarse, coarse)
        up = np.linalg.eigh(held)[1][:, 0]
        up = up if up @ coarse > 0 else -up
        if up @ coarse > np.cos(_CHANGE_RAD):
            self.direction = up

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes."""
        return {
            "direction": self.direction.copy(),
            "votes": self._votes.copy(),
            "scatter": self._scatter.copy(),
        }

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self.direction = np.array(arrays["direction"])
        self._votes, self._scatter = np.array(arrays["votes"]), np.array(arrays["scatter"])


@functools.cache
def _directions() -> Array:
    """Unit vectors [K, 3], evenly spread over the sphere (a Fibonacci spiral)."""
    number = np.arange(_DIRECTIONS) + 0.5
    polar = np.arccos(1 - 2 * number / _DIRECTIONS)
    azimuth = np.pi * (1 + 5**0.5) * number
    return np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1
    )


def _agreement(cosine: Array) -> Array:
    """How well planes [K, N] fit directions, by the cosine between: level or upright, 0 to 1."""
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    level = np.exp(-((angle / _KERNEL_RAD) ** 2))
    upright = np.exp(-(((np.pi / 2 - angle) / _KERNEL_RAD) ** 2))
    return np.asarray(level + _UPRIGHT * upright)


def _habit(up_camera: Array) -> Array:
    """How likely each direction [K, 3] in camera coordinates is up, as a log, 0 at best."""
    pitch_down = np.arcsin(np.clip(-up_camera[:, 2], -1.0, 1.0))
    roll = np.arctan2(up_camera[:, 0], -up_camera[:, 1])
    # Near the poles of pitch, roll means nothing; past the horizon, the camera hangs.
    roll = np.where(np.cos(pitch_down) > 0.05, roll, 0.0)
    return np.asarray(
        -0.5 * ((pitch_down - _PITCH_DOWN_RAD) / _PITCH_RAD) ** 2 - 0.5 * (roll / _ROLL_RAD) ** 2
    )
