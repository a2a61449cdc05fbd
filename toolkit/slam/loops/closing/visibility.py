"""Compact description of the volume and the points that the keyframes of a submap observe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.frustum import Frustum, far_depth_m
from toolkit.slam.submaps.submap import Submap

# Maximum number of keyframes of a submap, evenly distributed.
_MAX_VIEWS = 30


@dataclass(frozen=True)
class Visibility:
    """Viewing volumes of keyframes and the points [P, 3] each observed, in the world frame."""

    volumes: list[Frustum]
    points: list[NDArray[np.float64]]

    @classmethod
    def of(cls, submap: Submap) -> Visibility:
        """Compute the visibility of a submap."""
        count = len(submap.keyframes)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_VIEWS)).round().astype(int))
        volumes, points = [], []
        for index in chosen:
            keyframe = submap.keyframes[index]
            if len(keyframe.points) == 0:
                continue
            T_world_camera = submap.T_world_camera(keyframe)
            far_m = far_depth_m(keyframe.points[:, 2])
            volumes.append(Frustum(keyframe.camera, T_world_camera, far_m=max(far_m, 0.2)))
            rotated = keyframe.points_in_map() @ submap.T_world_submap[:3, :3].T
            points.append(rotated + submap.T_world_submap[:3, 3])
        return cls(volumes, points)

    def overlap(self, other: Visibility) -> float:
        """Largest overlap of a view of one submap with a view of the other."""
        return max(_largest_fraction(self, other), _largest_fraction(other, self))


def _largest_fraction(volumes: Visibility, points: Visibility) -> float:
    """Largest fraction of a view's points inside one of the volumes."""
    fractions = [
        float(volume.contains(view).mean()) for volume in volumes.volumes for view in points.points
    ]
    return max(fractions, default=0.0)
