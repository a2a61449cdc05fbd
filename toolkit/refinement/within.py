"""Stage 1 of global refinement: optimise each submap on all its keyframes (G, end of III.C)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.mapping.mapper import Mapper
from toolkit.submaps.atlas import Atlas


def refine_submaps(
    atlas: Atlas, mapper: Mapper, T_world_cameras_of: Callable[[int], NDArray[np.float64]]
) -> None:
    """Optimise every readable submap of this run; all submaps are inactive afterwards.

    Submaps of a saved map were refined at the end of the run that created them.

    Args:
        T_world_cameras_of: returns the poses [P, 4, 4] of all frames in the same part of the map as
            the submap of a number.
    """
    if len(atlas) == 1:
        # The active submap still has its optimiser state.
        mapper.refine(atlas.current, se3.inverse(atlas.T_world_submap(0)) @ T_world_cameras_of(0))
        atlas.store_active()
        return
    atlas.store_active()
    for number in (n for n in atlas.readable() if n >= atlas.saved):
        submap = atlas.submap(number).to(mapper.device)
        mapper.refine(submap, se3.inverse(submap.T_world_submap) @ T_world_cameras_of(number))
        atlas.put(submap.to("cpu"))
