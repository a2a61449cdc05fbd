"""What the keyframes of a submap observe: small enough to be kept for all submaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.frustum import Frustum, far_depth_m
from toolkit.submaps.submap import Submap

# Maximum number of keyframes of a submap, evenly spread.
_MAX_VIEWS = 30


@dataclass(frozen=True)
class Visibility:
    """Viewing volumes of some keyframes, and the points [P, 3] that each observed, in the world."""

    volumes: list[Frustum]
    points: list[NDArray[np.float64]]

    @classmethod
    def of(cls, submap: Submap) -> Visibility:
        """Compute the visibility of a submap."""
        count = len(submap.keyframes)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_VIEWS)).round().astype(int))
        volumes, points = [], []
        for place in chosen:
            keyframe = submap.keyframes[place]
            if len(keyframe.points) == 0:
                continue
            T_world_camera = submap.T_world_camera(keyframe)
            reach_m = far_depth_m(keyframe.points[:, 2])
            volumes.append(Frustum(keyframe.camera, T_world_camera, far_m=max(reach_m, 0.2)))
            seen = keyframe.points_in_map() @ submap.T_world_submap[:3, :3].T
            points.append(seen + submap.T_world_submap[:3, 3])
        return cls(volumes, points)

    def shared(self, other: Visibility) -> float:
        """Largest overlap of a view of one submap with a view of the other."""
        return max(_largest(self, other), _largest(other, self))


def _largest(one: Visibility, other: Visibility) -> float:
    shares = [
        float(volume.contains(points).mean()) for volume in one.volumes for points in other.points
    ]
    return max(shares, default=0.0)
