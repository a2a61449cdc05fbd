"""Whether the camera can have moved to where a frame was found, by how it moved before."""

from __future__ import annotations

from toolkit.slam.tracking.evidence import unexpected_reason
from toolkit.slam.tracking.motion import ConstantVelocity
from toolkit.slam.tracking.reach import Reach, contradicted, doubted
from toolkit.slam.tracking.result import TrackingResult

_TOO_FAR = "the camera cannot have moved so far"


def is_reached(result: TrackingResult, reach: Reach | None) -> bool:
    """Whether the camera can be at a pose; it can if nothing is known."""
    return reach is None or reach.contains(result.T_map_camera)


def unless_implausible(
    result: TrackingResult,
    motion: ConstantVelocity,
    timestamp_s: float,
    reach: Reach | None,
    followed: bool,
) -> TrackingResult:
    """The result, doubtful or lost if the motion that it means is not to be believed.

    Args:
        motion: before the frame. timestamp_s: of the frame.
        reach: where the camera may be, by that motion.
        followed: whether features were followed into the frame.
    """
    bound = motion.bound(timestamp_s)
    if not result.lost and bound is not None and not bound.contains(result.T_map_camera):
        result = contradicted(result, _TOO_FAR)
    if motion.has_restarted() and not result.lost:
        # No motion before tells whether the first one of a part is likely.
        result = doubted(result, unexpected_reason(result.similarity))
        if not is_reached(result, reach):
            result = contradicted(result, _TOO_FAR)
    # After a gap, nothing but this frame tells where the camera went, and doors are alike.
    gone = not followed and not result.lost
    if gone and motion.has_moved_on(timestamp_s, result.T_map_camera):
        result = contradicted(result, "after a gap, the camera may be at a similar place")
    return result
