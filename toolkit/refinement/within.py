"""Stage 1 of global refinement: optimise each submap on all its keyframes (G, end of III.C)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.submaps.atlas import Atlas


def refine_submaps(atlas: Atlas, T_submap_cameras: Mapping[int, NDArray[np.float64]]) -> None:
    """Optimise every readable submap of this run; all submaps are inactive afterwards.

    Submaps of a saved map were refined at the end of the run that created them.

    Args:
        T_submap_cameras: poses [M, 4, 4] of all frames of each submap, by its number.
    """
    mapper = atlas.mapper
    if len(atlas) == 1:
        # The active submap still has its optimiser state.
        mapper.refine(T_submap_cameras.get(0))
        atlas.store_active()
        return
    atlas.store_active()
    for number in (n for n in atlas.readable() if n >= atlas.saved):
        submap = atlas.submap(number)
        mapper.replace_content(submap.content)
        mapper.refine(T_submap_cameras.get(number))
        content = mapper.content
        submap.gaussians, submap.keyframes = content.gaussians, content.keyframes
        submap.seeded_by, submap.steps = content.seeded_by, content.steps
        atlas.put(submap)
