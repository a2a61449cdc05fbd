"""Instances of a finished map: objects of all submaps are joined, and every Gaussian gets one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import evenly_spaced
from toolkit.scene.instances.association import Overlaps, add_votes
from toolkit.scene.instances.joining import join_duplicates, join_parts, join_submaps
from toolkit.scene.instances.result import InstanceMap, MapObject
from toolkit.scene.instances.tracking import SAVED, InstanceTracker
from toolkit.scene.instances.voting import GaussianVotes, MaskedKeyframe, masked_keyframes
from toolkit.scene.instances.voxels import VoxelVotes
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.submaps.atlas import Atlas

# Maximum number of keyframes of a submap that vote for its Gaussians; limits time.
_MAX_VIEWS = 256


def finish_instances(
    tracker: InstanceTracker, atlas: Atlas, maps: Sequence[FusedMap | None]
) -> InstanceMap:
    """Join the objects at the final poses, and give every Gaussian its object.

    Args:
        tracker: the objects of all submaps; it must not be used afterwards.
        atlas: all submaps, inactive, each in the frame of its part of the map.
        maps: the fused map of each part, None where it is not readable.
    """
    join_parts(tracker)
    readable = [one for one in maps if one is not None]
    votes: dict[int, VoxelVotes] = {}
    for fused in readable:
        own = {n: _replayed(tracker, atlas, n) for n in fused.numbers if n >= atlas.saved}
        table = tracker.table()
        for one in own.values():
            one.relabel(table)
        if tracker.saved is not None and min(fused.numbers) < atlas.saved:
            loaded = tracker.saved.votes(tracker.options.voxel_m)
            loaded.relabel(table)
            join_submaps(tracker, own | {SAVED: loaded})
        else:
            join_submaps(tracker, own)
        votes |= own
    table = tracker.table()
    counted: dict[int, GaussianVotes] = {}
    for fused in readable:
        for number in fused.numbers:
            one = votes.get(number, VoxelVotes(tracker.options.voxel_m))
            one.relabel(table)
            means = fused.part(number).means.double().numpy()
            known = None
            if tracker.saved is not None and number < atlas.saved:
                known = table[tracker.saved.of(number, means)]
            counted[number] = GaussianVotes(means, one, len(table) - 1, known)
            for masked in _masked(tracker, atlas, number, table):
                counted[number].add(masked)
    return _numbered(tracker, counted, len(table))


def _masked(
    tracker: InstanceTracker, atlas: Atlas, number: int, table: NDArray[np.int32]
) -> Iterator[MaskedKeyframe]:
    """The keyframes of a submap with masks, at their final poses."""
    records = [record for record in tracker.records if record.submap == number]
    if not records:
        return iter(())
    submap = atlas.submap(number)
    chosen = evenly_spaced(submap.keyframes, _MAX_VIEWS)
    keyframes = ((keyframe, submap.T_world_camera(keyframe)) for keyframe in chosen)
    return masked_keyframes(keyframes, records, table)


def _replayed(tracker: InstanceTracker, atlas: Atlas, number: int) -> VoxelVotes:
    """The votes of a submap's keyframes at their final poses; duplicates are merged."""
    votes = VoxelVotes(tracker.options.voxel_m)
    for masked in _masked(tracker, atlas, number, tracker.table()):
        seen = masked.seen(votes.voxel_m)
        rows = votes.rows_of(seen)
        overlaps = Overlaps.of(seen, votes, rows, len(masked.objects))
        add_votes(votes, seen, rows, overlaps, masked.objects, tracker.settled)
    join_duplicates(tracker, votes)
    return votes


def _numbered(
    tracker: InstanceTracker, counted: dict[int, GaussianVotes], objects: int
) -> InstanceMap:
    """Number the objects with enough Gaussians from 1, in the order in which they were seen.

    Objects of a loaded map keep their numbers, and new ones follow.
    """

    def total(ids: dict[int, NDArray[np.int32]]) -> NDArray[np.int64]:
        counts = np.zeros(objects, np.int64)
        for part in ids.values():
            counts += np.bincount(part, minlength=objects)
        return counts

    counts = total({number: votes.winners() for number, votes in counted.items()})
    kept = counts >= max(tracker.options.min_gaussians, 1)
    loaded = [n for n, one in tracker.objects.items() if one.submap == SAVED]
    kept[loaded] = counts[loaded] > 0
    kept[0] = False
    ids = {number: votes.winners(kept) for number, votes in counted.items()}
    counts = total(ids)
    order = [n for n in sorted(tracker.objects) if kept[n]]
    table = np.zeros(objects, np.int32)
    new = [n for n in order if tracker.objects[n].submap != SAVED]
    table[loaded] = loaded
    last = 0 if tracker.saved is None else int(tracker.saved.ids.max(initial=0))
    table[new] = last + np.arange(1, len(new) + 1)
    found = [
        MapObject(
            int(table[n]),
            tracker.objects[n].class_name,
            int(counts[n]),
            tracker.objects[n].mean_score,
            tracker.objects[n].views,
            tracker.objects[n].first,
            tracker.objects[n].last,
            tracker.objects[n].embeddings.fused(),
        )
        for n in order
    ]
    model = "" if tracker.embedded is None else tracker.embedded[1]
    return InstanceMap(found, {number: table[part] for number, part in ids.items()}, model)
