"""A map of unknown scale becomes a submap in metres, with virtual keyframes."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.image_sides import mean_up
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.splat_maps.localisation import LocatedFrame, SplatMapLocaliser
from toolkit.slam.loops.splat_maps.viewpoints import extent, viewpoints
from toolkit.slam.loops.splat_maps.views import view_camera, virtual_keyframe
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.tracker import LocatingTracker
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import Backend

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Number of views that frames are searched in, and of those that become keyframes.
_SEARCHED, _KEPT = 200, 64
# Until its scale is known, a map is given this extent, that of a room, in metres.
_EXTENT_M = 6.0
# Minimum length of the mean of the cameras' unit vectors down, for a vertical of the map.
_MIN_UPRIGHT = 0.7


@dataclass(frozen=True)
class MapParts:
    """What a map is searched with.

    Attributes:
        backend: renders views of the map.
        tracker: aligns frames to the map.
        describer: computes the descriptors of keyframes, of colour images.
    """

    backend: Backend
    tracker: LocatingTracker
    describer: ViewDescriber


@dataclass(frozen=True, eq=False)
class MetricMap:
    """A map in metres.

    Attributes:
        submap: Gaussians in the axes of the file, and virtual keyframes.
        metres_per_unit: of the file.
        spread: standard deviation of this scale between frames, as a fraction of it.
        frames: the located frames.
    """

    submap: Submap
    metres_per_unit: float
    spread: float
    frames: tuple[LocatedFrame, ...]


def metric_map(
    cloud: GaussianCloud, camera: Camera, frames: Iterable[Frame], parts: MapParts
) -> MetricMap | None:
    """Locate frames in a map of unknown scale, and scale it to metres.

    Args:
        cloud: the map, in any unit of length.
        camera: of the frames.
        frames: with depth, in the order in which they are tried.

    Returns:
        The map; None if fewer than two frames are found in it at one scale.
    """
    size = extent(cloud)
    if size <= 0.0:
        return None
    roomy = cloud.scaled(_EXTENT_M / size)
    small = view_camera(camera)
    # Maps often start at the first camera of their recording.
    poses = [np.eye(4), *viewpoints(roomy, small, _SEARCHED)]
    views = list(_rendered(roomy, small, poses, parts))
    _log.info("Looking for frames in %d views of %s.", len(views), roomy)

    def render(T_map_camera: Array) -> Keyframe | None:
        return virtual_keyframe(parts.backend, roomy, small, T_map_camera, len(views))

    localiser = SplatMapLocaliser(roomy, views, render, parts.tracker)
    located = localiser.located(frames)
    if not located:
        return None
    logs = np.log([frame.units_per_metre for frame in located])
    # Few matches are often near each other, so that their number determines the scale badly.
    weights = np.array([frame.matches for frame in located], np.float64) ** 2
    metres_per_roomy = float(np.exp(-np.average(logs, weights=weights)))
    metric = roomy.scaled(metres_per_roomy)
    seen = [_scaled(frame.T_map_camera, metres_per_roomy) for frame in located]
    poses = [*seen, *viewpoints(metric, small, _KEPT, _vertical(seen))]
    keyframes = list(_rendered(metric, small, poses, parts))
    if not keyframes:
        return None
    return MetricMap(
        _submap(metric, keyframes, parts.describer),
        metres_per_roomy * _EXTENT_M / size,
        float(np.std(logs)),
        tuple(located),
    )


def _rendered(
    cloud: GaussianCloud, camera: Camera, poses: Iterable[Array], parts: MapParts
) -> Iterator[Keyframe]:
    """The views of a map that show enough of it."""
    for index, T_map_camera in enumerate(poses):
        view = virtual_keyframe(parts.backend, cloud, camera, T_map_camera, index)
        if view is not None:
            yield view


def _scaled(T_map_camera: Array, factor: float) -> Array:
    """A pose in a map whose lengths are multiplied by a factor."""
    T = T_map_camera.copy()
    T[:3, 3] *= factor
    return T


def _vertical(T_map_cameras: list[Array]) -> Array | None:
    """The direction [3] towards the top of the images of most cameras.

    Virtual views are held like the cameras, whatever side of the images is up.
    """
    up = mean_up(np.array(T_map_cameras), "top")
    length = float(np.linalg.norm(up))
    return np.asarray(up / length) if length >= _MIN_UPRIGHT else None


def _submap(cloud: GaussianCloud, keyframes: list[Keyframe], describer: ViewDescriber) -> Submap:
    with torch.no_grad():
        descriptors = [
            describer.describe((keyframe.rgb.to(torch.float32) / 255.0)[None])[0].numpy()
            for keyframe in keyframes
        ]
    seeded_by = torch.zeros(len(cloud), dtype=torch.int32)
    return Submap(0, np.eye(4), cloud, keyframes, seeded_by, np.stack(descriptors))
