"""What is known of each object: its class, embedding, views and the object it is a part of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from toolkit.scene.instances.embeddings import ViewEmbeddings


@dataclass
class TrackedObject:
    """An object of one submap while the map grows.

    Attributes:
        number: from 1, unique in the run.
        submap: number of its submap.
        first, last: indices of the first and the last keyframe with one of its masks.
        views: number of its masks.
        area: pixels of its masks.
        score: sum of the masks' scores.
        classes: weight of each class name.
        embeddings: those of the masks.
        parent: object that this one was first seen as a part of, 0 for none.
    """

    number: int
    submap: int
    first: int
    last: int
    views: int = 0
    area: float = 0.0
    score: float = 0.0
    classes: dict[str, float] = field(default_factory=dict)
    embeddings: ViewEmbeddings = field(default_factory=ViewEmbeddings)
    parent: int = 0

    @property
    def class_name(self) -> str | None:
        """The most frequent class name; None if none is known."""
        return class_name_of([self])

    @property
    def mean_score(self) -> float:
        """Mean score of the masks, in [0, 1]."""
        return self.score / max(self.views, 1)

    def see(self, index: int, area: float, class_name: str | None, score: float) -> None:
        """Add a mask of the keyframe `index`."""
        self.first, self.last = min(self.first, index), max(self.last, index)
        self.views += 1
        self.area += area
        self.score += score
        if class_name is not None:
            self._add_class(class_name, area * score)

    def absorb(self, other: TrackedObject) -> None:
        """Add all masks of another object."""
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.views += other.views
        self.area += other.area
        self.score += other.score
        for name, weight in other.classes.items():
            self._add_class(name, weight)
        self.embeddings.absorb(other.embeddings)

    def _add_class(self, name: str, weight: float) -> None:
        self.classes[name] = self.classes.get(name, 0.0) + weight

    def values(self) -> dict[str, Any]:
        """JSON values, without the embeddings."""
        return {
            "number": self.number,
            "submap": self.submap,
            "first": self.first,
            "last": self.last,
            "views": self.views,
            "area": self.area,
            "score": self.score,
            "classes": dict(self.classes),
            "parent": self.parent,
        }

    @classmethod
    def from_values(cls, values: dict[str, Any], embeddings: ViewEmbeddings) -> TrackedObject:
        """Restore an object from its `values` and its embeddings."""
        return cls(**values | {"embeddings": embeddings})


def class_name_of(objects: Iterable[TrackedObject]) -> str | None:
    """The most frequent class name of objects that are one; None if none is known."""
    weights: dict[str, float] = {}
    for one in objects:
        for name, weight in one.classes.items():
            weights[name] = weights.get(name, 0.0) + weight
    return min(weights, key=lambda name: (-weights[name], name), default=None)
