"""Association of the masks of a keyframe with the objects of a submap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.objects import TrackedObject
from toolkit.scene.instances.voxels import MaskedVoxels, VoxelVotes

Array = NDArray[np.float64]

# Minimum score of a mask and an object: their intersection over union in known voxels, ...
_MIN_SCORE = 0.2
# ... multiplied by this if their classes differ, plus this much per difference of their
# embeddings' similarity from that of the other masks and objects in view.
_OTHER_CLASS, _PER_SIMILARITY = 0.4, 0.3
# Minimum number of shared voxels of a match, or minimum fraction of those of a small mask.
_MIN_SHARED, _MIN_FRACTION = 4.0, 0.3
# Fraction of the visible part of an object that a mask must contain to cover it.
COVERED = 0.6
# Fraction of a mask inside an object from which it shows a part of the object.
_CONTAINED = 0.7
# Fraction of a part of an object below a mask from which both are the same, and fraction of the
# mask's voxels with a vote for the part.
_MOST, _VOTED = 0.5, 0.5


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Overlaps of K masks with the visible objects; row 0 is of the pixels without a mask.

    Attributes:
        objects: [O] ascending numbers of the visible objects.
        shared: [K + 1, O] number of shared voxels; a voxel counts in proportion to its votes.
        present: [K + 1, O] number of the mask's voxels with any vote for the object.
        size: [K + 1] number of voxels of the masks.
    """

    objects: NDArray[np.int32]
    shared: Array
    present: Array
    size: Array

    @classmethod
    def of(
        cls, seen: MaskedVoxels, votes: VoxelVotes, rows: NDArray[np.int32], masks: int
    ) -> Overlaps:
        """Compare masks with the objects in the voxels `rows` that they cover."""
        known = rows >= 0
        owners, weights = votes.owners[rows[known]], votes.votes[rows[known]].astype(np.float64)
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
        objects = np.unique(owners[owners > 0])
        place = np.searchsorted(objects, owners)
        cell = (seen.mask[known].astype(np.int64) * len(objects))[:, None] + place
        voted = owners > 0
        shape, cells = (masks + 1, len(objects)), (masks + 1) * len(objects)
        return cls(
            objects.astype(np.int32),
            np.bincount(cell[voted], weights[voted], cells).reshape(shape).astype(np.float64),
            np.bincount(cell[voted], minlength=cells).reshape(shape).astype(np.float64),
            np.bincount(seen.mask, minlength=masks + 1).astype(np.float64),
        )

    @property
    def visible(self) -> Array:
        """Number [O] of visible voxels of each object."""
        return np.asarray(self.shared.sum(axis=0))

    @property
    def known(self) -> Array:
        """Number [K + 1] of voxels of each mask that belong to any object."""
        return np.asarray(self.shared.sum(axis=1))

    @property
    def covered(self) -> Array:
        """Fraction [K + 1, O] of the visible part of each object below each mask."""
        return np.asarray(self.shared / np.maximum(self.visible, 1e-9))


@dataclass(frozen=True, eq=False)
class Association:
    """Objects of the masks of a keyframe.

    Attributes:
        objects: [K] object of each mask, 0 for none.
        parents: [K] object that a mask without one shows a part of, 0 for none.
    """

    objects: NDArray[np.int32]
    parents: NDArray[np.int32]


def associate(
    overlaps: Overlaps,
    masks: InstanceMasks,
    classes: Sequence[str | None],
    known: Mapping[int, TrackedObject],
) -> Association:
    """Assign at most one mask to each visible object.

    Args:
        classes: [K] class names of the masks.
        known: the objects by number.
    """
    count = len(masks)
    found = np.zeros(count + 1, np.int32)
    parents = np.zeros(count + 1, np.int32)
    if len(overlaps.objects):
        scores = _scores(overlaps, masks, classes, [known[int(n)] for n in overlaps.objects])
        free = _match(scores, overlaps.objects, found, np.ones(len(overlaps.objects), bool))
        # A part of an object that is still outvoted in most of its voxels.
        again = np.where(overlaps.covered >= _MOST, overlaps.covered, 0.0)
        again[overlaps.present < _VOTED * overlaps.size[:, None]] = 0.0
        again[0] = 0.0
        _match(again, overlaps.objects, found, free)
        best = overlaps.shared.argmax(axis=1)
        inside = overlaps.shared.max(axis=1) >= _CONTAINED * np.maximum(overlaps.size, 1.0)
        parents = np.where(inside & (found == 0), overlaps.objects[best], 0).astype(np.int32)
    return Association(found[1:], parents[1:])


def _scores(
    overlaps: Overlaps,
    masks: InstanceMasks,
    classes: Sequence[str | None],
    objects: Sequence[TrackedObject],
) -> Array:
    """Scores [K + 1, O] of masks and objects, 0 where they cannot match."""
    shared = overlaps.shared
    union = overlaps.known[:, None] + overlaps.visible - shared
    scores = shared / np.maximum(union, 1e-9)
    names = [one.class_name for one in objects]
    for row, name in enumerate(classes, start=1):
        if name is not None:
            other = np.array([n is not None and n != name for n in names])
            scores[row, other] *= _OTHER_CLASS
    scores[1:] += _PER_SIMILARITY * _similarities(masks, objects) * (scores[1:] > 0)
    enough = np.minimum(_MIN_SHARED, _MIN_FRACTION * overlaps.size)[:, None]
    scores[(shared < enough) | (scores < _MIN_SCORE)] = 0.0
    scores[0] = 0.0
    return np.asarray(scores)


def _similarities(masks: InstanceMasks, objects: Sequence[TrackedObject]) -> Array:
    """Cosines [K, O] of embeddings minus their mean; 0 where one is unknown.

    Encoders differ in the similarity of unrelated images, which the mean removes.
    """
    length = masks.embeddings.shape[1]
    directions = np.zeros((len(objects), length), np.float32)
    for row, one in enumerate(objects if length else ()):
        fused = one.embeddings.fused()
        if fused is not None:
            directions[row] = fused.embedding
    cosines = masks.embeddings @ directions.T if length else np.zeros((len(masks), len(objects)))
    known = np.outer(masks.embeddings.any(axis=1), directions.any(axis=1))
    if not known.any():
        return np.zeros((len(masks), len(objects)))
    return np.where(known, cosines - cosines[known].mean(), 0.0).astype(np.float64)


def _match(
    scores: Array,
    objects: NDArray[np.int32],
    found: NDArray[np.int32],
    free: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Match masks and objects in the order of their scores; return the objects still free."""
    rows, columns = np.nonzero(scores > 0)
    order = np.argsort(-scores[rows, columns], kind="stable")
    for row, column in zip(rows[order], columns[order], strict=True):
        if found[row] == 0 and free[column]:
            found[row], free[column] = objects[column], False
    return free


def add_votes(
    votes: VoxelVotes,
    seen: MaskedVoxels,
    rows: NDArray[np.int32],
    overlaps: Overlaps,
    objects: NDArray[np.int32],
    settled: Callable[[int], bool],
) -> None:
    """Add the votes of a keyframe's masks for their objects.

    Settled objects that a mask covers as a whole keep their voxels: the mask may show several
    objects.

    Args:
        rows: [E] rows of the voxels (`VoxelVotes.rows_of`).
        objects: [K] object of each mask, 0 for none.
        settled: whether an object keeps its voxels.
    """
    target = np.concatenate([[0], objects]).astype(np.int32)[seen.mask]
    voting = target > 0
    if len(overlaps.objects):
        keeps = np.array([settled(int(n)) for n in overlaps.objects])
        kept = (overlaps.covered >= COVERED) & keeps
        known = np.flatnonzero((rows >= 0) & voting)
        owner = votes.owners[rows[known], 0]
        column = np.minimum(np.searchsorted(overlaps.objects, owner), len(keeps) - 1)
        foreign = (owner > 0) & (owner != target[known])
        voting[known[foreign & kept[seen.mask[known], column]]] = False
    # Votes go to the voxels that were found, so that noise does not double surfaces.
    keys = np.where(rows >= 0, votes.keys[rows] if len(votes) else 0, seen.keys)[voting]
    keys, first = np.unique(keys, return_index=True)
    votes.add(keys, target[voting][first], rows[voting][first])
