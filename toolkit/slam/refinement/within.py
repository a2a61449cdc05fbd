"""Stage 1 of global refinement: optimise each submap on all its keyframes (G, end of III.C)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.mapping.final_optimisation import step_count
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER, LowPass

# Wraps the numbers of all optimisation steps in a progress bar.
StepProgress = Callable[[range], Iterable[int]]


def refine_submaps(
    atlas: Atlas,
    mapper: Mapper,
    T_world_cameras_of: Callable[[int], NDArray[np.float64]],
    progress: StepProgress = iter,
) -> None:
    """Optimise every readable submap of this run; all submaps are inactive afterwards.

    Submaps of a saved map were refined at the end of the run that created them.

    Args:
        T_world_cameras_of: returns the poses [P, 4, 4] of all frames in the same part of the map as
            the submap of a number.
        progress: follows the optimisation steps.
    """
    own = [number for number in atlas.readable() if number >= atlas.saved]
    low_pass = _low_pass(atlas)
    total = sum(step_count(mapper.options, len(atlas.keyframe_poses(number))) for number in own)
    steps = iter(progress(range(total)))
    if len(atlas) == 1:
        # The active submap still has its optimiser state.
        T_map_cameras = se3.inverse(atlas.T_world_submap(0)) @ T_world_cameras_of(0)
        mapper.refine(atlas.current, T_map_cameras, steps, low_pass)
        atlas.store_active()
    else:
        atlas.store_active()
        for number in own:
            submap = atlas.submap(number).to(mapper.device)
            T_map_cameras = se3.inverse(submap.T_world_submap) @ T_world_cameras_of(number)
            mapper.refine(submap, T_map_cameras, steps, low_pass)
            atlas.put(submap.to("cpu"))
    next(steps, None)  # completes the progress bar


def _low_pass(atlas: Atlas) -> LowPass:
    """The filter of new ellipsoids: that of a loaded map, with which they are rendered."""
    for number in range(atlas.saved):
        if number not in atlas.unreadable:
            cloud = atlas.submap(number).gaussians
            if cloud.ellipsoids is not None:
                return cloud.low_pass
    return PIXEL_FILTER
