"""Transitions between submaps: the next one starts with what its first keyframe sees of another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.depth_lookup import depths_at
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import NO_LOW_PASS, GaussianCloud
from toolkit.splatting.rendering import SurfaceView

# Number of optimisation steps around a boundary before the old submap is closed.
_STEPS = 24
# Maximum distance of a visible Gaussian behind the rendered surface, as a fraction of depth.
_MAX_BEHIND = 0.05
_NO_INDICES = torch.zeros(0, dtype=torch.int64)


def start_next(atlas: Atlas, mapper: Mapper) -> NDArray[np.float64]:
    """Start the next submap at the newest keyframe, which then belongs to both submaps.

    Returns:
        T_new_old [4, 4], from the frame of the old submap to that of the new one.
    """
    old = atlas.current
    mapper.optimise_window(old, _STEPS, atlas.boundary.bundle_adjustment)
    last = old.keyframes[-1]
    anchor = replace(last, T_map_camera=np.eye(4), pose_moments=None)
    _start(atlas, mapper, anchor, atlas.submap(atlas.active), last.T_map_camera)
    return se3.inverse(last.T_map_camera)


def start_at(
    atlas: Atlas,
    mapper: Mapper,
    anchor: Keyframe,
    place: tuple[int, NDArray[np.float64]],
    inherit: bool = True,
) -> None:
    """Start a submap at a keyframe that was located in an existing submap.

    Args:
        anchor: the first keyframe, at the identity.
        place: number of the existing submap, and the keyframe's T_submap_camera [4, 4] in it.
        inherit: False if the pose is uncertain, so that no Gaussians are copied.
    """
    number, T_submap_camera = place
    source = atlas.submap(number)
    if inherit:
        located = replace(anchor, T_map_camera=T_submap_camera)
        mapper.exposures.estimate(located, source.keyframes)
        anchor = replace(located, T_map_camera=anchor.T_map_camera)
    _start(atlas, mapper, anchor, source, T_submap_camera, inherit)


def _start(
    atlas: Atlas,
    mapper: Mapper,
    anchor: Keyframe,
    source: Submap,
    T_source_camera: NDArray[np.float64],
    inherit: bool = True,
) -> None:
    """Start a submap at a keyframe that has a pose in an existing submap."""
    index = _NO_INDICES
    # Ellipsoids of a finished map are too large to be tracked against, and are not merged again.
    if inherit and atlas.boundary.inherit and source.gaussians.ellipsoids is None:
        index = _seen(mapper, anchor, source, T_source_camera)
    copies = source.gaussians.select(index).transformed(se3.inverse(T_source_camera))
    submap = Submap(
        len(atlas),
        atlas.T_world_submap(source.number) @ T_source_camera,
        replace(
            copies,
            centred_colours=mapper.options.centred,
            ellipsoids=None,
            low_pass=NO_LOW_PASS,
        ),
        [],
        torch.full((len(copies),), anchor.index, dtype=torch.int32),
        _boundary_row(atlas, anchor.index),
        OptimiserState(source.optimiser.steps.index_select(0, index)),
    )
    mapper.skip_deferred_steps()
    atlas.start(submap.to(atlas.device))
    mapper.add_keyframe(atlas.current, anchor)


def _seen(
    mapper: Mapper, anchor: Keyframe, source: Submap, T_source_camera: NDArray[np.float64]
) -> Tensor:
    """Indices [V] of the Gaussians of a submap that a keyframe at a pose in it sees."""
    view = mapper.render(source.gaussians, anchor.camera, T_source_camera)
    T_camera_source = se3.inverse(T_source_camera)
    return visible_gaussians(view, source.gaussians, anchor.camera, T_camera_source)


def _boundary_row(atlas: Atlas, index: int) -> NDArray[np.float32]:
    """Descriptor [1, D] of the keyframe that two submaps share; [0, D] if there is none."""
    descriptors, poses = atlas.descriptors(atlas.active), atlas.keyframe_poses(atlas.active)
    shared = next(reversed(poses), None) == index
    return descriptors[-1:].copy() if shared else descriptors[:0].copy()


def visible_gaussians(
    view: SurfaceView, cloud: GaussianCloud, camera: Camera, T_camera_map: NDArray[np.float64]
) -> Tensor:
    """Indices [V] of the Gaussians on the surface visible in a rendered view of the map."""
    points = cloud.transformed(T_camera_map).means.double().numpy()
    at = depths_at(points, view.depth_m.numpy(), camera)
    return torch.from_numpy(at.index[at.z_m <= (1.0 + _MAX_BEHIND) * at.depth_m])
