"""A frame to be located in a map, and the views of the map that it is aligned to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame, Recorder
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.stages import Stage
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.slam.tracking.prepared import PreparedFrame
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel
from toolkit.splatting.alignment.levels import model_level, pyramid, view_level
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

Array = NDArray[np.float64]

# Minimum silhouette of the rendered pixels that frames are aligned to.
_MIN_SILHOUETTE = 0.9


@dataclass(frozen=True)
class RenderedView:
    """The map rendered at a pose.

    Attributes:
        T_map_view: [4, 4].
        images: pyramid from fine to coarse; intensity and depth are 0 where the map is missing.
        levels: the same with derivatives and planes, which frames are aligned to.
    """

    T_map_view: Array
    images: list[FrameLevel]
    levels: list[ModelLevel]


class MapRenderer:
    """Renders the views that frames are aligned to."""

    def __init__(self, backend_name: str, recorder: Recorder) -> None:
        self._backend, self._recorder = backend(backend_name), recorder

    def view(
        self, gaussians: GaussianCloud, camera: Camera, T_map_view: Array, levels: int
    ) -> RenderedView:
        """Render Gaussians from a pose [4, 4], at a number of pyramid levels."""
        with self._recorder.timed(Stage.TRACKING_RENDER):
            options, T_view_map = RenderOptions(_MIN_SILHOUETTE), se3.inverse(T_map_view)
            surface = render_surface(self._backend, gaussians, camera, T_view_map, options)
            images = pyramid(view_level(surface, _MIN_SILHOUETTE), levels)
            return RenderedView(T_map_view.copy(), images, [model_level(i) for i in images])


@dataclass(frozen=True)
class Task:
    """A frame to be located in a map.

    Attributes:
        features: what its features tell.
        after_ambiguous: whether the frame before did not determine its pose.
    """

    prepared: PreparedFrame
    gaussians: GaussianCloud
    features: FeaturePose | None = None
    after_ambiguous: bool = False

    @property
    def frame(self) -> Frame:
        """The frame without preprocessing."""
        return self.prepared.frame

    @property
    def levels(self) -> list[FrameLevel]:
        """Image pyramid of the frame, from fine to coarse."""
        return self.prepared.levels

    @property
    def camera(self) -> Camera:
        """Camera of the finest level."""
        return self.levels[0].camera

    def distance(self, T_map_first: Array, T_map_second: Array) -> float:
        """Size of the motion between two poses [4, 4]."""
        return self.size(se3.inverse(T_map_first) @ T_map_second)

    def size(self, motion: Array) -> float:
        """Size of a motion [4, 4]; see `apparent_motion`."""
        return apparent_motion(motion, self.prepared.median_depth_m)


def apparent_motion(motion: Array, depth_m: float) -> float:
    """Translation of a motion [4, 4] as a fraction of the median depth, plus rotation (rad).

    This is about the displacement of the image in focal lengths.
    """
    metres, radians = np.linalg.norm(motion[:3, 3]), se3.rotation_angle_rad(motion[:3, :3])
    return float(metres / depth_m + radians)
