"""Which frames become keyframes, and which keyframes a mapping call optimises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe

# Number of newest keyframes that do not count as an earlier visit.
RECENT = 20
# Keyframes that a frame's surface is looked for in: the number of nearest ones, their maximum
# motion from the frame, as translation over median depth plus radians, and the maximum ratio of
# their distances from the surface. Pixels per row that are looked for.
_NEAREST, _SIMILAR, _FARTHER, _SAMPLES = 30, 1.0, 1.5, 32
# Fraction of the surface of a frame that shows nothing new.
SEEN = 0.9


class KeyframeChoice(Protocol):
    """Decides which tracked frames become keyframes; by default a `KeyframePolicy`."""

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe; see `KeyframePolicy.wants`."""
        ...


def wants_view(
    choice: KeyframeChoice,
    keyframes: Sequence[Keyframe],
    index: int,
    T_map_camera: NDArray[np.float64],
    revisit: float,
    visited: int = 0,
) -> bool:
    """Whether the view of a frame should become the next keyframe of a submap.

    Args:
        choice: decides by time and overlap.
        keyframes: of the submap, in order; the first frame always becomes one.
        index: of the frame.
        T_map_camera: [4, 4] pose of the frame.
        revisit, visited: see `is_revisit`.
    """
    if not keyframes:
        return True
    last = keyframes[-1]
    if not choice.wants(index - last.index, last.fraction_seen_by(T_map_camera)):
        return False
    return not is_revisit(keyframes, T_map_camera, revisit, visited)


def is_revisit(
    keyframes: Sequence[Keyframe],
    T_map_camera: NDArray[np.float64],
    max_motion: float,
    visited: int = 0,
) -> bool:
    """Whether a keyframe of an earlier visit has about the view of a camera.

    The newest keyframes are of the same visit, except for those of an earlier one.

    Args:
        keyframes: of one submap, in order.
        T_map_camera: [4, 4] pose of the camera.
        max_motion: between the views, as translation over median depth plus rotation in radians.
        visited: number of first keyframes that are known to be of earlier visits.
    """
    earlier = keyframes[: max(len(keyframes) - RECENT, visited)]
    if not earlier:
        return False
    metres, radians = view_motions([k.T_map_camera for k in earlier], T_map_camera)
    near = np.flatnonzero(radians < max_motion).tolist()
    return any(metres[i] < (max_motion - radians[i]) * earlier[i].median_depth_m for i in near)


def seen_fraction(
    keyframes: Sequence[Keyframe], frame: Frame, T_map_camera: NDArray[np.float64]
) -> float:
    """Fraction of a frame's surface that keyframes with similar views have measured, from as near.

    Args:
        keyframes: of one submap.
        T_map_camera: [4, 4] pose of the frame.

    Returns:
        Value in [0, 1]; 0 if the frame has no depth.
    """
    points = frame.camera.unproject(frame.depth_m, max(1, frame.camera.width // _SAMPLES))
    points = points[points[..., 2] > 0]
    if not len(points):
        return 0.0
    unseen = se3.transform_points(T_map_camera, points)
    farthest_m = _FARTHER * points[:, 2]
    metres, radians = view_motions([k.T_map_camera for k in keyframes], T_map_camera)
    motions = metres / float(np.median(points[:, 2])) + radians
    for number in np.argsort(motions, kind="stable")[:_NEAREST].tolist():
        if motions[number] > _SIMILAR or not len(unseen):
            break
        rest = ~keyframes[number].measures(unseen, farthest_m)
        unseen, farthest_m = unseen[rest], farthest_m[rest]
    return 1.0 - len(unseen) / len(points)


def view_motions(
    T_map_views: Sequence[NDArray[np.float64]], T_map_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances (metres) and angles (radians) [K] of K views from a camera, all [4, 4]."""
    motions = se3.inverse(T_map_camera) @ np.array(T_map_views).reshape(-1, 4, 4)
    radians = np.atleast_1d(se3.rotation_angle_rad(motions[:, :3, :3]))
    return np.linalg.norm(motions[:, :3, 3], axis=1), radians


def choose_window(
    keyframes: list[Keyframe],
    size: int,
    min_overlap: float,
    generator: np.random.Generator,
) -> list[Keyframe]:
    """Choose the newest keyframe and up to `size - 1` random keyframes that overlap with it.

    Args:
        keyframes: at least one, in order.
        size: maximum number of keyframes in the window.
        min_overlap: minimum fraction of the newest keyframe's points visible in the others.
        generator: chooses among the overlapping keyframes.
    """
    newest = keyframes[-1]
    others = keyframes[:-1]
    poses = np.array([k.T_map_camera for k in others]).reshape(-1, 4, 4)
    overlaps = newest.fractions_seen_by(poses)
    overlapping = [k for k, overlap in zip(others, overlaps, strict=True) if overlap > min_overlap]
    count = min(size - 1, len(overlapping))
    chosen = (
        [overlapping[i] for i in generator.choice(len(overlapping), count, replace=False)]
        if count
        else []
    )
    return [newest, *chosen]
