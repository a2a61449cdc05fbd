"""The pose that dense alignment and features determine together.

Each source is weighted by what it measures: alignment by the rise of its cost, features by their
errors. Features of a sensor whose depth is not registered to its colours, or whose rows are exposed
one after another, contradict alignment by more than that; then they count less.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.splatting.alignment.determinacy import UNITS

Array = NDArray[np.float64]

# Information that is assumed where neither source has any.
_WEAK = 1e-3 * np.eye(6)
# Standard deviation, in units of `UNITS`, from which a frame does not determine a direction, and
# that which ends the doubt.
_UNDETERMINED, _DETERMINED = 0.2, 0.12
_NAMES = ("to the side", "up and down", "forwards and backwards", "pitch", "yaw", "roll")


@dataclass(frozen=True, eq=False)
class Combination:
    """A pose with all that is known about it.

    Attributes:
        T_map_camera: [4, 4].
        information: [6, 6] of x in T_map_camera exp(x), as the sources were weighted.
        known: [6, 6] that of both sources, as far as their disagreement lets one believe it.
        disagreement: squared distance of both sources per degree of freedom, 1 if they agree within
            their errors; 0 without features.
        motions: see `FeaturePose`.
    """

    T_map_camera: Array
    information: Array = field(repr=False)
    known: Array = field(repr=False)
    disagreement: float = 0.0
    motions: tuple[float, float] | None = None

    @property
    def covariance(self) -> Array:
        """Covariance [6, 6] of x; 1 m and 1 rad in directions without information."""
        return np.asarray(np.linalg.inv(self.information + np.eye(6)))

    def ambiguity(self, after_ambiguous: bool = False) -> str:
        """Why other motions explain the frame as well; empty if none does.

        Args:
            after_ambiguous: whether this was so in the frame before. Where a view determines
                nothing, single frames seem to determine something; one that ends the doubt must do
                so clearly.
        """
        if self.motions is not None:
            first, second = (100.0 * share for share in self.motions)
            return f"{first:.0f} % of the features move in one way, {second:.0f} % in another"
        sigma, axis = _least_determined(self.known)
        if sigma < (_DETERMINED if after_ambiguous else _UNDETERMINED):
            return ""
        name = _NAMES[int(np.argmax(np.abs(axis)))]
        return f"the view does not determine the motion: {name}"


def is_determined(information: Array) -> bool:
    """Whether information [6, 6] about a motion is enough in each direction."""
    return _least_determined(information)[0] < _UNDETERMINED


def _least_determined(information: Array) -> tuple[float, Array]:
    """Largest standard deviation of a motion, in units of `UNITS`, and its direction [6]."""
    covariance = np.linalg.inv(information + np.eye(6))
    variances, axes = np.linalg.eigh(covariance / np.outer(UNITS, UNITS))
    return float(np.sqrt(variances[-1])), axes[:, -1]


def combined(T_map_camera: Array, information: Array, features: FeaturePose | None) -> Combination:
    """Combine the result of an alignment with the pose of the features.

    Args:
        T_map_camera: [4, 4] by alignment.
        information: [6, 6] of x in T_map_camera exp(x), by alignment.
    """
    if features is None:
        return Combination(T_map_camera, information, information)
    difference = se3.log(se3.inverse(T_map_camera) @ features.T_map_camera)
    covariance = np.linalg.inv(information + _WEAK) + np.linalg.inv(features.information + _WEAK)
    disagreement = float(difference @ np.linalg.solve(covariance, difference)) / len(difference)
    # With covariances that are larger by the square of the Birge ratio, both would agree. Their
    # weight falls faster: it is the calibration of the features that is wrong.
    known: Array = features.information / max(1.0, disagreement)
    own: Array = known / max(1.0, disagreement)
    step = np.asarray(np.linalg.solve(information + own + _WEAK, own @ difference), np.float64)
    T = se3.orthonormalise(T_map_camera @ se3.exp(step))
    return Combination(T, information + own, information + known, disagreement, features.motions)
