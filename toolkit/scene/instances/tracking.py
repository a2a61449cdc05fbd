"""Instances while the map grows: every keyframe's masks find their objects, or start new ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.scene.instances.association import COVERED, Association, Overlaps, add_votes, associate
from toolkit.scene.instances.embeddings import ViewEmbeddings
from toolkit.scene.instances.evidence import PairEvidence, pairs_of
from toolkit.scene.instances.masks import InstanceMasks, MaskSource
from toolkit.scene.instances.objects import TrackedObject
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.records import KeyframeMasks, records_state, restored_records
from toolkit.scene.instances.saved import SavedObjects
from toolkit.scene.instances.voxels import MaskedVoxels, VoxelVotes, sampled, sampling_step
from toolkit.semantics.embedding_fusion import view_weights

Array = NDArray[np.float64]

# Number of the submap of loaded objects, which belong to all submaps of their map.
SAVED = -1
# Area of loaded objects: they keep their numbers and classes if they are joined with others.
_SAVED_AREA = 1e12
_SAVED_ARRAYS = ("points_m", "ids", "submap")
# Minimum number of voxels of a mask that starts an object, and of an object that is evidence.
_MIN_VOXELS, _MIN_VISIBLE = 3, 4
# Objects seen this often keep their voxels below a mask that covers several objects.
_SETTLED_VIEWS = 2
# Maximum number of masks in a frame; the smallest ones beyond are ignored.
_MAX_MASKS = 4000
# Number of records among which that of a new keyframe is.
_LAST_RECORDS = 8
# Minimum fraction of a mask with one class label.
_MIN_CLASS = 0.5


class InstanceTracker:
    """The objects of all submaps.

    Args:
        options: size of voxels and of objects.
        source: yields the masks of keyframes; None to keep the objects of a loaded map only.
        class_names: names of the class ids of keyframes, for masks without a class.
        connected: masks are connected surfaces, and objects are what they connect.

    Attributes:
        source: yields the masks, or None.
        saved: Gaussians of a loaded map with their objects, or None.
        objects: objects by number.
        records: the masks of all keyframes, in order.
        evidence: which objects are one, and which are not.
        merged: objects that became part of others, by number.
        votes: of the keyframes of each submap for the objects in its voxels.
        embedded: length of the masks' embeddings and name of their model; None without.
    """

    def __init__(
        self,
        options: InstanceOptions,
        source: MaskSource | None,
        class_names: Mapping[int, str] | None = None,
        connected: bool = False,
    ) -> None:
        self.options = options
        self.objects: dict[int, TrackedObject] = {}
        self.records: list[KeyframeMasks] = []
        self.evidence = PairEvidence(connected)
        self.merged: dict[int, int] = {}
        self.embedded: tuple[int, str] | None = None
        self.saved: SavedObjects | None = None
        self.source, self._class_names = source, class_names or {}
        self.votes: dict[int, VoxelVotes] = {}
        self._seen: set[tuple[int, int]] = set()
        self._next = 1

    @property
    def is_idle(self) -> bool:
        """Whether there are neither masks nor objects of a loaded map."""
        return self.source is None and self.saved is None

    def load(self, saved: SavedObjects, offset: int) -> None:
        """Load the objects of an earlier map, before the first keyframe; they keep their numbers.

        Args:
            saved: the objects.
            offset: added to their frame indices.
        """
        # What is needed from the objects moves to the tracked ones, which may be joined.
        self.saved = replace(saved, objects=[])
        for one in saved.objects:
            first, last = one.first + offset, one.last + offset
            found = TrackedObject(one.number, SAVED, first, last, one.views, _SAVED_AREA)
            found.score = one.score * one.views
            if one.class_name is not None:
                found.classes = {one.class_name: _SAVED_AREA}
            if one.embedding is not None:
                found.embeddings.add(first, one.embedding.weight, one.embedding.embedding)
                self.embedded = (len(one.embedding.embedding), saved.model)
            self.objects[one.number] = found
            self._next = max(self._next, one.number + 1)

    def update(self, submap: int, keyframes: Sequence[Keyframe]) -> None:
        """Associate the masks of the newest keyframes of a submap with its objects.

        Args:
            submap: its number.
            keyframes: all of its keyframes, in order. Those at the end that the stage has not seen
                are new; a submap may start with keyframes of the one before.

        Raises:
            DatasetError: the masks of a frame are invalid.
        """
        if self.source is None:
            return
        new = list(takewhile(lambda k: (submap, k.index) not in self._seen, reversed(keyframes)))
        for keyframe in reversed(new):
            self._seen.add((submap, keyframe.index))
            self._add(submap, keyframe, self.source.masks(keyframe))

    def _add(self, submap: int, keyframe: Keyframe, masks: InstanceMasks | None) -> None:
        if masks is None or not len(masks):
            return
        masks = _limited(masks)
        self._check_embeddings(masks, keyframe.index)
        step = sampling_step(keyframe.camera.width)
        ids = sampled(masks.ids, step)
        votes = self.votes.setdefault(submap, VoxelVotes(self.options.voxel_m))
        depth_m = keyframe.depth_m.numpy()
        pose = keyframe.T_map_camera
        seen = MaskedVoxels.of(ids, depth_m, keyframe.camera, pose, self.options.voxel_m)
        rows = votes.rows_of(seen)
        overlaps = Overlaps.of(seen, votes, rows, len(masks))
        classes = self._classes(masks, ids, keyframe, step)
        association = associate(overlaps, masks, classes, self.objects)
        areas = np.bincount(ids.reshape(-1), minlength=len(masks) + 1)[1:] * float(step**2)
        found = self._objects_of(association, overlaps, submap, keyframe.index)
        weights = view_weights(areas, seen.distances(len(masks)), masks.scores)
        for k in np.flatnonzero(found):
            one = self.objects[int(found[k])]
            one.see(keyframe.index, float(areas[k]), classes[k], float(masks.scores[k]))
            one.embeddings.add(keyframe.index, float(weights[k]), masks.embeddings[k])
        covered = self._observe(overlaps)
        add_votes(votes, seen, rows, overlaps, found, self.settled)
        self.records.append(KeyframeMasks.of(keyframe.index, submap, found, ids))
        self._merge(votes, covered)

    def _check_embeddings(self, masks: InstanceMasks, index: int) -> None:
        length = masks.embeddings.shape[1]
        if not length:
            return
        found = (length, masks.model)
        self.embedded = self.embedded or found
        if found != self.embedded:
            new, old = (f"length {n}" + f" ({m})" * bool(m) for n, m in (found, self.embedded))
            raise DatasetError(
                f"the masks of frame {index} have embeddings of {new}, those of earlier frames of "
                f"{old}; compute all embeddings with one model"
            )

    def _classes(
        self, masks: InstanceMasks, ids: NDArray[np.int32], keyframe: Keyframe, step: int
    ) -> list[str | None]:
        """The class names of masks; by default, that of the labels of most of their pixels."""
        classes = list(masks.classes)
        if keyframe.class_ids is None or all(name is not None for name in classes):
            return classes
        labels = sampled(keyframe.class_ids.numpy(), step)
        best = _labels_of_masks(ids, labels, len(masks))
        for k, name in enumerate(classes):
            if name is None and best[k] > 0:
                classes[k] = self._class_names.get(int(best[k]))
        return classes

    def _objects_of(
        self, association: Association, overlaps: Overlaps, submap: int, index: int
    ) -> NDArray[np.int32]:
        """The object [K] of each mask; masks without one start a new object if large enough."""
        found = association.objects.copy()
        for k in np.flatnonzero((found == 0) & (overlaps.size[1:] >= _MIN_VOXELS)):
            parent = int(association.parents[k])
            number, self._next = self._next, self._next + 1
            self.objects[number] = TrackedObject(number, submap, index, index, parent=parent)
            if parent:
                self.evidence.add((parent, number), together=False)
            found[k] = number
        return found

    def _observe(self, overlaps: Overlaps) -> list[tuple[int, int]]:
        """Count which visible objects one mask covers, and which ones different masks cover.

        Returns:
            The pairs that one mask covers.
        """
        visible = np.flatnonzero(overlaps.visible >= _MIN_VISIBLE)
        covered = overlaps.covered[1:, visible] >= COVERED
        mask = np.where(covered.any(axis=0), covered.argmax(axis=0), -1)
        numbers, shown = overlaps.objects[visible][mask >= 0], mask[mask >= 0]
        mask_of = dict(zip(numbers.tolist(), shown.tolist(), strict=True))
        pairs = []
        for a, b in pairs_of(mask_of):
            together = mask_of[a] == mask_of[b]
            self.evidence.add((a, b), together)
            if together:
                pairs.append((a, b))
        return pairs

    def _merge(self, votes: VoxelVotes, pairs: Iterable[tuple[int, int]]) -> None:
        """Merge those of some pairs of objects that are one according to the evidence."""
        table = None
        for a, b in pairs:
            a, b = self.current(a), self.current(b)
            if a == b or not self.evidence.are_one(a, b):
                continue
            kept, gone = sorted((a, b), key=lambda n: (-self.objects[n].area, n))
            self.merge(kept, gone)
            table = np.arange(self._next, dtype=np.int32) if table is None else table
            table[table == gone] = kept
        if table is not None:
            votes.relabel(table)

    def merge(self, kept: int, gone: int) -> None:
        """Make an object part of another one."""
        self.objects[kept].absorb(self.objects.pop(gone))
        self.evidence.replace(gone, kept)
        self.merged[gone] = kept
        for one in self.objects.values():
            if one.parent == gone:
                one.parent = kept if one.number != kept else 0

    def record_of(self, submap: int, index: int) -> KeyframeMasks | None:
        """The masks of one of the last keyframes, None if it has none."""
        newest = reversed(self.records[-_LAST_RECORDS:])
        return next((r for r in newest if (r.index, r.submap) == (index, submap)), None)

    def settled(self, number: int) -> bool:
        """Whether an object was seen often enough to keep its voxels below a mask of several."""
        return self.objects[number].views >= _SETTLED_VIEWS

    def current(self, number: int) -> int:
        """The object that an object became part of; itself if it was not merged."""
        while number in self.merged:
            number = self.merged[number]
        return number

    def of_points(
        self, submap: int, points_m: Array, T_world_submap: Array
    ) -> NDArray[np.int32] | None:
        """The objects [N] of points of a submap so far, 0 for none; None if it has no masks.

        Args:
            submap: its number.
            points_m: [N, 3] in the frame of the submap.
            T_world_submap: [4, 4]; the world of a loaded map is that of its objects.
        """
        votes = self.votes.get(submap)
        if votes is not None:
            return votes.owner_at(points_m)
        if self.saved is None or not (self.saved.submap == submap).any():
            return None
        return self.table()[self.saved.of(submap, points_m, T_world_submap)]

    def embeddings(self, numbers: NDArray[np.integer]) -> dict[int, NDArray[np.float32]]:
        """The fused embeddings [D] of those objects that have one."""
        fused = {int(n): self.objects[n].embeddings.fused() for n in numbers.tolist() if n}
        return {number: one.embedding for number, one in fused.items() if one is not None}

    def table(self, others: Mapping[int, int] | None = None) -> NDArray[np.int32]:
        """The current object [M + 1] of every object number; `others` count as another one too."""
        found = np.arange(self._next, dtype=np.int32)
        for known in (others or {}, self.merged):
            found[list(known)] = list(known.values())
        while (found[found] != found).any():
            found = found[found]
        return found

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {f"records/{name}": array for name, array in records_state(self.records).items()}
        for submap, votes in self.votes.items():
            arrays |= {f"votes/{submap}/{name}": a for name, a in votes.state().items()}
        objects = list(self.objects.values())
        vectors = [one.embeddings.vectors().reshape(-1) for one in objects]
        arrays |= {
            "evidence": self.evidence.state(),
            "seen": np.array(sorted(self._seen), np.int64).reshape(-1, 2),
            "embeddings": np.concatenate([np.zeros(0, np.float16), *vectors]),
        }
        if self.saved is not None:
            arrays |= {f"saved/{name}": getattr(self.saved, name) for name in _SAVED_ARRAYS}
        values = {
            "objects": [one.values() for one in objects],
            "views": [one.embeddings.values() for one in objects],
            "embedded": self.embedded,
            "merged": [[a, b] for a, b in self.merged.items()],
            "submaps": list(self.votes),
            "next": self._next,
        }
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.records = restored_records(arrays_below(arrays, "records/"))
        self.votes = {}
        for submap in values["submaps"]:
            self.votes[submap] = VoxelVotes(self.options.voxel_m)
            self.votes[submap].restore(arrays_below(arrays, f"votes/{submap}/"))
        saved = arrays_below(arrays, "saved/")
        self.saved = None
        if saved:
            points_m, ids, own = (np.array(saved[name]) for name in _SAVED_ARRAYS)
            self.saved = SavedObjects([], points_m, ids, own)
        self.evidence.restore(arrays["evidence"])
        self._seen = {(int(submap), int(index)) for submap, index in arrays["seen"]}
        self.merged = {int(a): int(b) for a, b in values["merged"]}
        self._next = int(values["next"])
        self.embedded = None
        if values["embedded"] is not None:
            self.embedded = int(values["embedded"][0]), str(values["embedded"][1])
        length = 1 if self.embedded is None else self.embedded[0]
        vectors, row = np.array(arrays["embeddings"]).reshape(-1, length), 0
        self.objects = {}
        for one, views in zip(values["objects"], values["views"], strict=True):
            own = vectors[row : row + len(views["frames"])]
            restored = ViewEmbeddings.from_values(views, own)
            self.objects[int(one["number"])] = TrackedObject.from_values(one, restored)
            row += len(own)


def _labels_of_masks(
    ids: NDArray[np.integer], labels: NDArray[np.integer], count: int
) -> NDArray[np.intp]:
    """The label [K] of at least half of the labelled pixels of each mask, 0 for none.

    Args:
        ids: [H, W] masks 1..K of the pixels, 0 for none.
        labels: [H, W] classes, 0 for none.
        count: number K of masks.
    """
    width = int(labels.max(initial=0)) + 1
    keys = ids.reshape(-1).astype(np.int64) * width + labels.reshape(-1)
    cells = np.bincount(keys, minlength=(count + 1) * width).reshape(count + 1, width)[1:]
    cells[:, 0] = 0
    sure = cells.max(axis=1) >= _MIN_CLASS * np.maximum(cells.sum(axis=1), 1)
    return np.where(sure, cells.argmax(axis=1), 0)


def _limited(masks: InstanceMasks) -> InstanceMasks:
    """The largest masks of an image with very many."""
    if len(masks) <= _MAX_MASKS:
        return masks
    areas = np.bincount(masks.ids.reshape(-1), minlength=len(masks) + 1)[1:]
    return masks.select(np.sort(np.argsort(-areas, kind="stable")[:_MAX_MASKS]))
