"""Objects of a growing scene: voxels by submap, and what is known of each object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.growing.segments import SegmentVoxels
from toolkit.semantics.colour_names import COLOUR_NAMES

Array = NDArray[np.float64]
Keys = NDArray[np.int64]
Rows = TypeVar("Rows", Array, list[Array])

# Voxels that one keyframe saw are noise in objects that this number of keyframes has seen.
_SETTLED_VIEWS = 4


def thinned(rows: Rows, count: int) -> Rows:
    """Return about `count` evenly spaced rows, or all if there are fewer."""
    return rows[:: max(1, len(rows) // count)]


@dataclass
class Fragment:
    """The voxels of an object in one submap.

    Attributes:
        keys: [E] ascending numbers of voxels.
        rows: [E] row of `sums_m` of each voxel.
        sums_m: [E, 5] sum of the points in each voxel in the frame of the submap, their number, and
            that of the keyframes that saw the voxel; in the order in which voxels were seen.
    """

    keys: Keys = field(default_factory=lambda: np.zeros(0, np.int64))
    rows: Keys = field(default_factory=lambda: np.zeros(0, np.int64))
    sums_m: Array = field(default_factory=lambda: np.zeros((0, 5)))

    def add(self, keys: Keys, sums_m: Array) -> None:
        """Add voxels with ascending keys."""
        size = len(self.keys)
        if size == 0:
            self.keys, self.rows, self.sums_m = keys.copy(), np.arange(len(keys)), sums_m.copy()
            return
        places = np.searchsorted(self.keys, keys)
        known = self.keys.take(places, mode="clip") == keys
        self.sums_m[self.rows[places[known]]] += sums_m[known]
        if known.all():
            return
        new = ~known
        at = places[new] + np.arange(int(new.sum()))
        old = np.ones(size + len(at), bool)
        old[at] = False
        grown = np.empty((2, len(old)), np.int64)
        grown[0, old], grown[0, at] = self.keys, keys[new]
        grown[1, old], grown[1, at] = self.rows, np.arange(size, len(old))
        self.keys, self.rows = grown
        self.sums_m = np.concatenate([self.sums_m, sums_m[new]])

    def overlap(self, keys: Keys) -> int:
        """Return how many ascending keys are voxels of the fragment."""
        if not len(self.keys) or self.keys[0] > keys[-1] or self.keys[-1] < keys[0]:
            return 0
        places = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return int((self.keys[places] == keys).sum())

    @property
    def pixels(self) -> int:
        """Number of the points in all voxels."""
        return int(self.sums_m[:, 3].sum())

    def points_m(self, min_views: int) -> Array:
        """Return the mean point [n, 3] of each voxel that enough keyframes saw."""
        kept = self.sums_m[self.sums_m[:, 4] >= min_views]
        return kept[:, :3] / kept[:, 3:4]


@dataclass
class GrowingObject:
    """An object while the map grows.

    Attributes:
        number: from 1, unique in the run.
        class_id: of the taxonomy.
        first, last: frame indices of the first and the last keyframe that saw it.
        views: number of keyframes that saw it.
        colours: [K] pixels with each colour name.
        score: sum of the confidences of its views.
        fragments: its voxels by submap.
    """

    number: int
    class_id: int
    first: int
    last: int
    views: int = 0
    colours: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(len(COLOUR_NAMES), np.int64)
    )
    score: float = 0.0
    fragments: dict[int, Fragment] = field(default_factory=dict)

    def see(self, index: int, submap: int, voxels: SegmentVoxels, score: float) -> None:
        """Add what a keyframe sees of the object."""
        if index != self.last or self.views == 0:
            self.views += 1
            self.score += score
        self.last = max(self.last, index)
        self.colours[: len(voxels.colours)] += voxels.colours
        self.fragments.setdefault(submap, Fragment()).add(voxels.keys, voxels.sums_m)

    def absorb(self, other: GrowingObject) -> None:
        """Add another object, which is a part of this one."""
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.views = max(self.views, other.views)
        self.score = max(self.score, other.score)
        self.colours = self.colours + other.colours
        for submap, part in other.fragments.items():
            self.fragments.setdefault(submap, Fragment()).add(part.keys, part.sums_m[part.rows])

    @property
    def size(self) -> int:
        """Number of voxels."""
        return sum(len(part.keys) for part in self.fragments.values())

    @property
    def confidence(self) -> float:
        """Mean confidence of its views, in [0, 1]."""
        return self.score / max(self.views, 1)

    @property
    def colour(self) -> str:
        """Name of its most frequent colour."""
        return COLOUR_NAMES[int(self.colours.argmax())]

    def points_m(self, T_world_submap: Mapping[int, Array]) -> Array:
        """Return its points [n, 3] in the world.

        Args:
            T_world_submap: [4, 4] pose of each of its submaps, in metres.
        """
        min_views = 2 if self.views >= _SETTLED_VIEWS else 1
        found = self._points_m(T_world_submap, min_views)
        return found if len(found) else self._points_m(T_world_submap, 1)

    def _points_m(self, T_world_submap: Mapping[int, Array], min_views: int) -> Array:
        parts = [
            part.points_m(min_views) @ T_world_submap[n][:3, :3].T + T_world_submap[n][:3, 3]
            for n, part in sorted(self.fragments.items())
        ]
        return np.concatenate(parts)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values of a checkpoint."""
        arrays: dict[str, NDArray] = {"colours": self.colours}
        for submap, part in self.fragments.items():
            own = {"keys": part.keys, "rows": part.rows, "sums_m": part.sums_m}
            arrays |= {f"{submap}/{name}": array for name, array in own.items()}
        values = {
            "number": self.number, "class_id": self.class_id, "first": self.first,
            "last": self.last, "views": self.views, "score": self.score,
            "submaps": list(self.fragments),
        }  # fmt: skip
        return arrays, values

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray], values: dict[str, Any]) -> GrowingObject:
        """Restore an object from its `state`."""
        fragments = {
            int(n): Fragment(*(np.array(arrays[f"{n}/{k}"]) for k in ("keys", "rows", "sums_m")))
            for n in values["submaps"]
        }
        own = {k: values[k] for k in ("number", "class_id", "first", "last", "views", "score")}
        return cls(**own, colours=np.array(arrays["colours"]), fragments=fragments)
