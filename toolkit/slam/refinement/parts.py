"""Parts of a map: groups of submaps with known relative poses, and unknown poses between groups.

A part starts where a lost camera could not be relocalised. A verified loop joins it to another.
Parts that were never joined have no common frame, so each one has its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.submaps.atlas import Atlas

Part = tuple[int, ...]


def by_size(
    parts: Sequence[Part],
    frame_submaps: Sequence[int],
    reliable: Sequence[bool],
    saved: int = 0,
) -> list[Part]:
    """Sort parts by decreasing number of reliable frames; the first one is the main part.

    If a frame was located in a loaded map, the part of the loaded map is the main part, because its
    frame is that of the world.

    Args:
        parts: submap numbers of each part.
        frame_submaps: [M] number of the submap of each frame.
        reliable: [M] whether the pose of the frame is not doubtful.
        saved: number of loaded submaps, which come first.
    """
    counts = Counter(frame_submaps)
    reliable_counts = Counter(compress(frame_submaps, reliable))

    def rank(part: Part) -> tuple[bool, int, int, int]:
        frames = sum(counts[number] for number in part)
        sure = sum(reliable_counts[number] for number in part)
        return (not (part[0] < saved and frames), -sure, -frames, part[0])

    return sorted(parts, key=rank)


def T_part_world(atlas: Atlas, part: Part) -> NDArray[np.float64]:
    """Transformation [4, 4] to the frame of a part, which is that of its first submap.

    The part of the first submap of all keeps the world frame.
    """
    first, *_ = part
    return np.eye(4) if first == 0 else se3.inverse(atlas.T_world_submap(first))


def separate(atlas: Atlas, parts: Sequence[Part]) -> None:
    """Move the anchors of each part to the part's own frame, at the end of a run."""
    for part in parts:
        first, *others = part
        if first == 0:
            continue
        T = T_part_world(atlas, part)
        for number in others:
            atlas.move(number, se3.orthonormalise(T @ atlas.T_world_submap(number)))
        atlas.move(first, np.eye(4))
