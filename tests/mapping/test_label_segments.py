"""Connected segments of label images."""

from __future__ import annotations

import numpy as np

from toolkit.mapping.consensus import connected_segments


def test_every_connected_area_is_one_segment_of_its_class():
    labels = np.array(
        [
            [4, 4, 0, 7, 7],
            [4, 0, 0, 0, 7],
            [0, 0, 4, 0, 0],
            [4, 0, 0, 0, 4],
        ]
    )
    segments, classes = connected_segments(labels)
    assert np.array_equal(classes[segments], labels)
    assert np.unique(segments).tolist() == list(range(len(classes)))
    assert sorted(classes.tolist()) == [0, 4, 4, 4, 4, 7]
    sizes = sorted(zip(classes.tolist(), np.bincount(segments.ravel()).tolist(), strict=True))
    assert sizes == [(0, 11), (4, 1), (4, 1), (4, 1), (4, 3), (7, 3)]
