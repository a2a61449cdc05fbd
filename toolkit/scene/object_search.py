"""Objects of a map ranked by the similarity of their embeddings to that of a text or image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.object_embeddings import ObjectEmbeddings, unit_rows


@dataclass(frozen=True)
class RankedObject:
    """An object of a ranking.

    Attributes:
        row: row of the object in `ObjectEmbeddings`.
        similarity: cosine similarity to the query, in [-1, 1].
    """

    row: int
    similarity: float


def rank_objects(
    objects: ObjectEmbeddings, query: NDArray[np.floating], count: int, model: str | None = None
) -> list[RankedObject]:
    """Return the objects that are most similar to a query, the most similar one first.

    Of objects of equal similarity, the one with the smaller id comes first.

    Args:
        objects: the objects.
        query: [D] embedding of a text or image; its length does not matter.
        count: maximum number of results.
        model: name of the model that made the query, None if it is unknown.

    Raises:
        FormatError: the model or the dimension is another one than that of the objects, or the
            query is zero or not finite.
    """
    if model is not None and model != objects.model:
        raise FormatError(
            f"the query was embedded by '{model}', the objects by '{objects.model}'; similarities "
            "between two models mean nothing: use the model of the objects"
        )
    if query.shape != (objects.dimensions,):
        raise FormatError(
            f"the query has shape {list(query.shape)}, the embeddings of the objects have "
            f"{objects.dimensions} values; use the model of the objects, '{objects.model}'"
        )
    if not np.isfinite(query).all() or not np.any(query):
        raise FormatError("the embedding of the query is zero or not finite; compute it again")
    similarities = unit_rows(objects.embeddings) @ unit_rows(query[None])[0]
    order = np.lexsort((objects.ids, -similarities))[:count]
    return [RankedObject(int(row), float(similarities[row])) for row in order]
