"""What the keyframes of a finished run see: small depth images rendered from its map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.depth_lookup import depths_at
from toolkit.datasets.resize import ImageGrid
from toolkit.runs.maps.finished import FinishedRun
from toolkit.splatting.rendering import backend, render_surface

Array = NDArray[np.float64]

# Width of the images in pixels, and maximum number of keyframes, evenly spaced.
_WIDTH, _MAX_VIEWS = 96, 150
# A point is at the surface of a pixel if their depths differ by less than this; one pixel of a
# surface seen at a grazing angle spans about 2 % of its depth.
_SAME_M, _SAME_SHARE = 0.06, 0.02
# Points nearer than this are behind the camera.
_NEAR_M = 0.05


@dataclass(frozen=True)
class Sight:
    """How one view sees points.

    Attributes:
        surface: [N] whether the map has a surface at the point.
        through: [N] whether the view sees a surface behind the point.
    """

    surface: NDArray[np.bool_]
    through: NDArray[np.bool_]


@dataclass(frozen=True)
class KeyframeViews:
    """Depth images of keyframes.

    Attributes:
        camera: intrinsics of the images.
        frames: frame index of each view.
        T_map_camera: [K, 4, 4] their poses.
        depth_m: [K, H, W] depth, not finite or 0 where there is no surface.
    """

    camera: Camera
    frames: list[int]
    T_map_camera: Array
    depth_m: NDArray[np.float32]

    def __len__(self) -> int:
        """Number of views."""
        return len(self.frames)

    def sight(self, view: int, points_m: Array) -> Sight:
        """Return how a view sees points [N, 3] of the map."""
        local = se3.transform_points(se3.inverse(self.T_map_camera[view]), points_m)
        at = depths_at(local, self.depth_m[view], self.camera, _NEAR_M)
        known = np.isfinite(at.depth_m) & (at.depth_m > 0)
        gap = np.where(known, at.depth_m.astype(np.float64) - at.z_m, 0.0)
        tolerance = _SAME_M + _SAME_SHARE * at.z_m
        surface, through = np.zeros((2, len(points_m)), bool)
        surface[at.index] = known & (np.abs(gap) <= tolerance)
        through[at.index] = known & (gap > tolerance)
        return Sight(surface, through)

    def end_points(self, view: int) -> tuple[Array, NDArray[np.bool_]]:
        """Return the surface points [H, W, 3] of a view in the map, and which are known [H, W]."""
        depth_m = self.depth_m[view].astype(np.float64)
        known = np.isfinite(depth_m) & (depth_m > 0)
        local = self.camera.unproject(np.where(known, depth_m, 0.0))
        return se3.transform_points(self.T_map_camera[view], local), known


def keyframe_views(run: FinishedRun) -> KeyframeViews:
    """Render the depth of the keyframes of a run that have a pose."""
    keyframes = set(run.keyframes)
    tracked = [f for f in run.tracked if f.index in keyframes] or run.tracked
    step = max(1, -(-len(tracked) // _MAX_VIEWS))
    shown = tracked[::step]
    height = max(1, round(_WIDTH * run.camera.height / run.camera.width))
    camera = ImageGrid(run.camera, (_WIDTH, height)).camera
    renderer = backend(run.settings.backend)
    depth_m = np.empty((len(shown), camera.height, camera.width), np.float32)
    for number, frame in enumerate(shown):
        T_camera_map = se3.inverse(frame.T_map_camera)
        surface = render_surface(renderer, run.gaussians, camera, T_camera_map)
        depth_m[number] = surface.depth_m.numpy()
    poses = np.array([f.T_map_camera for f in shown]).reshape(-1, 4, 4)
    return KeyframeViews(camera, [f.index for f in shown], poses, depth_m)
