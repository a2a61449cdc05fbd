"""The volume that the keyframes of a submap observed, and a view's overlap with it (G-III.A)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from toolkit.geometry import se3
from toolkit.geometry.frustum import observed_points
from toolkit.geometry.viewing_volume import ViewingVolume, inside_union
from toolkit.keyframe import Keyframe

# Number of points of an overlap estimate; its standard error is below 3 %.
_POINTS = 300


class SubmapVolume:
    """Union of the keyframes' viewing volumes; their meshes are cached between calls."""

    def __init__(self) -> None:
        # By frame index, with the depth image that each volume was computed from.
        self._volumes: dict[int, tuple[Tensor, ViewingVolume]] = {}

    def overlap(self, keyframe: Keyframe, others: Sequence[Keyframe]) -> float:
        """Fraction of a keyframe's observed surface inside the union of others' volumes (r_olap).

        Args:
            others: keyframes of the same submap.

        Returns:
            Value in [0, 1]; 0 if the keyframe has no depth.

        Raises:
            DependencyError: Open3D cannot be loaded.
        """
        points = observed_points(keyframe.camera, keyframe.depth_m.numpy(), _POINTS)
        points = se3.transform_points(keyframe.T_map_camera, points[points[:, 2] > 0])
        if not len(points):
            return 0.0
        entries = [self._volume(other) for other in others]
        self._volumes = {other.index: entry for other, entry in zip(others, entries, strict=True)}
        volumes = [volume for _, volume in entries]
        poses = np.array([other.T_map_camera for other in others])
        return float(inside_union(points, volumes, poses).mean())

    def _volume(self, keyframe: Keyframe) -> tuple[Tensor, ViewingVolume]:
        cached = self._volumes.get(keyframe.index)
        if cached is not None and cached[0] is keyframe.depth_m:
            return cached
        return keyframe.depth_m, ViewingVolume(keyframe.camera, keyframe.depth_m.numpy())
