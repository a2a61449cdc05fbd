"""Result of tracking a frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.splatting.alignment.similarity import Similarity


class Health(Enum):
    """Whether the pose of a frame is reliable."""

    GOOD = "tracked"
    DOUBTFUL = "doubtful"
    LOST = "lost"


@dataclass(frozen=True)
class TrackingResult:
    """The pose of a frame and its reliability.

    Attributes:
        T_map_camera: [4, 4] float64.
        converged: whether the last step was below the threshold.
        iterations: number of Gauss-Newton or Adam steps.
        renders: number of renderings of the map.
        intensity_residual: robust scale of the photometric residual, intensities in [0, 1].
        depth_residual_m: robust scale of the geometric residual at 1 m distance, metres.
        visible_fraction: fraction of the frame's measured pixels that the map explains.
        information: [6, 6] of a perturbation in the camera's frame, T_map_camera exp(x) with
            x = (translation, rotation), if the errors of pixels were independent.
        covariance: [6, 6] of the same perturbation, by what the view determines; None if it was not
            measured.
        health: GOOD; DOUBTFUL if the pose may be wrong and must not extend the map; or LOST.
        reason: why the frame is doubtful or lost; empty if it is neither.
        exposure: exposure of the frame against the map.
        similarity: of the frame and the map at the pose; None if it was not measured.
        T_by_features: [4, 4] as T_map_camera, by the features alone; None without them.
        ambiguous: whether other motions explain the frame as well, so that it cannot be relocalised
            either.
    """

    T_map_camera: NDArray[np.float64]
    converged: bool
    iterations: int
    renders: int
    intensity_residual: float
    depth_residual_m: float
    visible_fraction: float
    information: NDArray[np.float64] = field(repr=False)
    covariance: NDArray[np.float64] | None = field(default=None, repr=False)
    health: Health = Health.GOOD
    reason: str = ""
    exposure: Exposure = IDENTITY
    similarity: Similarity | None = None
    T_by_features: NDArray[np.float64] | None = field(default=None, repr=False)
    ambiguous: bool = False

    @property
    def lost(self) -> bool:
        """Whether the frame has no pose."""
        return self.health is Health.LOST

    @property
    def doubtful(self) -> bool:
        """Whether the pose may be wrong, so that the frame must not extend the map."""
        return self.health is Health.DOUBTFUL


def not_tracked(reason: str) -> TrackingResult:
    """Result for a frame that cannot be tracked, with the reason."""
    return TrackingResult(
        T_map_camera=np.eye(4),
        converged=False,
        iterations=0,
        renders=0,
        intensity_residual=float("nan"),
        depth_residual_m=float("nan"),
        visible_fraction=0.0,
        information=np.zeros((6, 6)),
        health=Health.LOST,
        reason=reason,
    )


def at_pose_of_last(T_map_camera: NDArray[np.float64], reason: str) -> TrackingResult:
    """Result for a frame that was not tracked, and why it is doubtful; empty if it is not."""
    health = Health.DOUBTFUL if reason else Health.GOOD
    return replace(not_tracked(reason), T_map_camera=T_map_camera, health=health)


def exposure_of(result: TrackingResult | None) -> Exposure:
    """Exposure of a frame against the map; the identity for a frame that was not located."""
    return IDENTITY if result is None or result.lost else result.exposure
