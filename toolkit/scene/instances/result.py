"""The objects of a finished map, and the object of every Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.embedding_fusion import FusedEmbedding


@dataclass(frozen=True, eq=False)
class MapObject:
    """An object of a finished map.

    Attributes:
        number: from 1; that of its Gaussians.
        class_name: of its masks; None if they have no class.
        gaussians: number of its Gaussians.
        score: mean score of its masks, in [0, 1].
        views: number of its masks.
        first, last: frame indices of the first and the last keyframe that saw it.
        embedding: fused from those of its masks; None without embeddings.
    """

    number: int
    class_name: str | None
    gaussians: int
    score: float
    views: int
    first: int
    last: int
    embedding: FusedEmbedding | None = None

    def values(self) -> dict[str, Any]:
        """JSON values, without the embedding."""
        return {
            "id": self.number,
            "class": self.class_name,
            "gaussians": self.gaussians,
            "score": round(self.score, 4),
            "views": self.views,
            "first_keyframe": self.first,
            "last_keyframe": self.last,
        }


@dataclass(frozen=True, eq=False)
class InstanceMap:
    """The instances of a finished map.

    Attributes:
        objects: in the order of their numbers.
        ids: by submap, the object [n] int32 of each of the Gaussians that the map keeps of it; 0
            is none.
        model: name of the model of the embeddings, empty if unknown.
    """

    objects: list[MapObject]
    ids: dict[int, NDArray[np.int32]]
    model: str = ""
