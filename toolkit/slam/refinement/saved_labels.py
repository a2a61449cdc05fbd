"""Labels of a loaded map without any: the keyframes of the run vote for its Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe, evenly_spaced
from toolkit.slam.mapping.consensus import label_consensus
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.refinement.parts import Part
from toolkit.slam.submaps.atlas import Atlas

# Maximum number of keyframes that vote, of all submaps together; limits memory and time.
_VOTING = 256


def label_saved(atlas: Atlas, mapper: Mapper, parts: Sequence[Part]) -> None:
    """Label the loaded submaps that have no labels, those of splat files.

    Gaussians that no labelled keyframe shows stay without a label. All submaps are inactive.

    Args:
        parts: of the map; keyframes vote for the submaps of their part.
    """
    if not mapper.semantics.channels:
        return
    for part in parts:
        readable = [number for number in part if number not in atlas.unreadable]
        own = [number for number in readable if number >= atlas.saved]
        for number in own and [n for n in readable if n < atlas.saved]:
            submap = atlas.submap(number)
            if mapper.semantics.classes_of(submap.gaussians.features).any():
                continue
            keyframes = list(_voting(atlas, own, number))
            cloud = submap.gaussians.to(mapper.device)
            render = partial(mapper.render, features=True)
            found = label_consensus(cloud, keyframes, mapper.semantics, render, rounds=0)
            atlas.put(replace(submap, gaussians=found.gaussians.to("cpu")))


def _voting(atlas: Atlas, numbers: Sequence[int], number: int) -> Iterator[Keyframe]:
    """Keyframes of submaps at their poses in the submap of a number."""
    T_submap_world = se3.inverse(atlas.T_world_submap(number))
    for other in numbers:
        submap = atlas.submap(other)
        for keyframe in evenly_spaced(submap.keyframes, max(1, _VOTING // len(numbers))):
            yield replace(keyframe, T_map_camera=T_submap_world @ submap.T_world_camera(keyframe))
