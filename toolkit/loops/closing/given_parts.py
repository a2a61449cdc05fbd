"""Parts of a map whose poses follow a trajectory of several parts."""

from __future__ import annotations

from collections.abc import Mapping

from toolkit.loops.closing.interface import NoLoopClosing
from toolkit.submaps.atlas import Atlas


class GivenParts(NoLoopClosing):
    """Groups submaps by the part of the trajectory that their first keyframe belongs to.

    Loops have been closed when the trajectory was estimated.

    Args:
        part_of_keyframe: number of the part by the index of a frame.
    """

    def __init__(self, part_of_keyframe: Mapping[int, int]) -> None:
        self._part_of_keyframe = part_of_keyframe

    def parts(self, atlas: Atlas) -> list[tuple[int, ...]]:
        """The submaps of each part of the trajectory, in the order of their first submaps."""
        found: dict[int, list[int]] = {}
        for number in range(len(atlas)):
            # Only the first submap can be empty.
            first = next(iter(atlas.keyframe_poses(number)), None)
            part = 0 if first is None else self._part_of_keyframe[first]
            found.setdefault(part, []).append(number)
        return [tuple(numbers) for numbers in found.values()]
