"""Rankings of objects by the similarity of embeddings."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.io.object_embeddings import ObjectEmbeddings
from toolkit.scene.object_search import rank_objects

OBJECTS = ObjectEmbeddings(
    np.array([7, 3, 5], np.int32),
    np.array([1, 2, 0], np.int32),
    np.array([[1, 0], [0.6, 0.8], [1, 0]], np.float32),
    np.ones(3, np.float32),
    "clip 1",
)


def test_the_most_similar_objects_come_first_and_ties_by_id():
    ranked = rank_objects(OBJECTS, np.array([5.0, 0.0]), 3, "clip 1")
    assert [OBJECTS.ids[r.row] for r in ranked] == [5, 7, 3]
    np.testing.assert_allclose([r.similarity for r in ranked], [1, 1, 0.6], atol=1e-6)
    (best,) = rank_objects(OBJECTS, np.array([0.0, -1.0]), 1)
    assert (OBJECTS.ids[best.row], best.similarity) == (5, 0)


@pytest.mark.parametrize(
    ("query", "model", "said"),
    [
        ([1.0, 0.0], "siglip 1", "embedded by 'siglip 1', the objects by 'clip 1'"),
        ([1.0, 0.0, 0.0], None, r"has shape \[3\], the embeddings of the objects have 2 values"),
        ([[1.0, 0.0]], None, r"has shape \[1, 2\]"),
        ([np.nan, 0.0], None, "zero or not finite"),
        ([0.0, 0.0], None, "zero or not finite"),
    ],
)
def test_queries_that_do_not_belong_to_the_objects_are_refused(query, model, said):
    with pytest.raises(FormatError, match=said):
        rank_objects(OBJECTS, np.array(query), 3, model)
