"""Views that registration compares: rendered from a submap, or observed by a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import view_level
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

# Minimum silhouette of pixels with a surface, and width above which images are halved.
_MIN_SILHOUETTE, _MAX_WIDTH = 0.9, 400
# Views with a smaller overlap are not used.
_MIN_OVERLAP = 0.1


@dataclass(frozen=True)
class SubmapView:
    """A view of a submap.

    Attributes:
        level: intensity and depth; depth is 0 where there is no surface.
        class_ids: [H, W] int32, 0 void, or None without semantics.
    """

    level: FrameLevel
    class_ids: NDArray[np.int32] | None = None

    @property
    def camera(self) -> Camera:
        """Intrinsics of the view."""
        return self.level.camera

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """[H, W], 0 where there is no surface."""
        return self.level.depth_m.numpy()


class ViewRenderer:
    """Renders submaps, decodes their classes, and counts the renderings.

    Args:
        semantics: decodes the features of the submaps; None disables classes.
    """

    def __init__(
        self, backend_name: str = "auto", semantics: SemanticMapping | None = None
    ) -> None:
        self.renders = 0
        self._backend = backend(backend_name)
        self._semantics = semantics if semantics is not None and semantics.channels else None

    @property
    def semantics(self) -> SemanticMapping | None:
        """Decodes the features of the submaps; None without classes."""
        return self._semantics

    @property
    def backend_name(self) -> str:
        """Name of the rendering backend."""
        return self._backend.name

    def camera_of(self, keyframe: Keyframe) -> Camera:
        """The keyframe's camera at the size of the renderings."""
        camera = keyframe.camera
        while camera.width > _MAX_WIDTH:
            camera = camera.halved()
        return camera

    def render(
        self, submap: Submap, camera: Camera, T_submap_camera: NDArray[np.float64]
    ) -> SubmapView:
        """Render a submap and decode its classes."""
        self.renders += 1
        options = RenderOptions(_MIN_SILHOUETTE, features=self._semantics is not None)
        T_camera_submap = se3.inverse(T_submap_camera)
        surface = render_surface(self._backend, submap.gaussians, camera, T_camera_submap, options)
        level = view_level(surface, _MIN_SILHOUETTE)
        if self._semantics is None:
            return SubmapView(level)
        class_ids = self._semantics.decode_view(surface).class_ids
        return SubmapView(level, class_ids.reshape(camera.height, camera.width))


def views_of_overlap(
    target: Submap, source: Submap, T_target_source: NDArray[np.float64], count: int
) -> list[int]:
    """The source keyframes with the largest overlap with a target keyframe, in descending order.

    Only points seen from the same side and without occlusion count as overlap: the two faces of a
    wall between rooms are close, but must not be aligned to each other. Views with little overlap
    are omitted; the list may be empty.
    """
    views = source.keyframes
    counts = np.array([len(k.points) for k in views])
    if not counts.any():
        return []
    # All points of all views in the target's coordinates, and the rays from their cameras.
    poses = np.array([T_target_source @ k.T_map_camera for k in views])
    parts = [k.points.astype(np.float64) for k in views]
    points = np.concatenate(
        [se3.transform_points(T, part) for T, part in zip(poses, parts, strict=True)]
    )
    owner = np.repeat(np.arange(len(views)), counts)
    rays = points - poses[owner, :3, 3]
    overlaps = np.zeros(len(views))
    for other in target.keyframes:
        same_side = np.einsum("ij,ij->i", rays, points - other.T_map_camera[:3, 3]) > 0.0
        seen = np.bincount(owner[same_side & other.reaches(points)], minlength=len(views))
        overlaps = np.maximum(overlaps, seen / np.maximum(counts, 1))
    order = np.argsort(-overlaps, kind="stable")
    return [int(i) for i in order if overlaps[i] >= _MIN_OVERLAP][:count]
