"""What finds the poses of frames: a tracker, and what else depends on where poses come from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.slam.length_unit import METRE, LengthUnit
from toolkit.slam.loops.closing.interface import LoopClosing
from toolkit.slam.tracking.placement import KeyframePlacement
from toolkit.slam.tracking.tracker import Tracker


@dataclass(frozen=True)
class FrontEnd:
    """What finds the poses of frames, and what the map needs for it.

    Attributes:
        tracker: estimates the pose of each frame against the map.
        closer: closes loops and relocalises the camera, or knows the parts of the trajectory; by
            default neither.
        placement: refines the poses of new keyframes against earlier ones; None if they are final.
        correction: gives frames that may become keyframes the depth of their priors, aligned with
            the map; None if depth is measured.
        tracks_priors: whether frames are tracked with that depth, for which the map is rendered at
            the predicted pose.
        start_velocity: [6] m/s and rad/s of the camera in the first frame, which a rolling shutter
            has bent; None if it is not known.
        unit: of length, in which the system works; frames and results are in metres. None for the
            one that suits the first frame with depth.
    """

    tracker: Tracker
    closer: LoopClosing = field(default_factory=LoopClosing)
    placement: KeyframePlacement | None = None
    correction: DepthCorrection | None = None
    tracks_priors: bool = False
    start_velocity: NDArray[np.float64] | None = None
    unit: LengthUnit | None = METRE
