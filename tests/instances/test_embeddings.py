"""Embeddings of the masks of an object: few are kept, and wrong ones do not count."""

from __future__ import annotations

import json

import numpy as np
import pytest
from panels import Scripted, keyframe, of_ids, panel_image, tracked

from toolkit.base.errors import DatasetError
from toolkit.scene.instances.embeddings import MAX_VIEWS, ViewEmbeddings
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker

AXES = np.eye(4, dtype=np.float32)


def views_of(rows: list[tuple[int, float, np.ndarray]]) -> ViewEmbeddings:
    views = ViewEmbeddings()
    for row in rows:
        views.add(*row)
    return views


def test_the_views_of_a_long_path_are_bounded_and_spread_over_it():
    views = views_of([(frame, 1.0, AXES[0]) for frame in range(5000)])
    assert MAX_VIEWS // 2 <= len(views) <= MAX_VIEWS
    assert max(np.diff([0, *views.frames, 5000])) <= 2 * 5000 / (MAX_VIEWS // 2)


def test_the_best_view_of_a_group_is_kept():
    weights = np.random.default_rng(0).uniform(0.1, 0.9, 400)
    weights[237] = 1.0
    views = views_of([(frame, float(w), AXES[0]) for frame, w in enumerate(weights)])
    assert 237 in views.frames


def test_wrong_views_do_not_change_the_embedding():
    rows = [(frame, 1.0, AXES[1] if frame % 4 == 3 else AXES[0]) for frame in range(12)]
    fused = views_of(rows).fused()
    assert fused is not None
    np.testing.assert_allclose(fused.embedding, AXES[0], atol=1e-6)


def test_unknown_embeddings_are_not_added():
    views = views_of([(0, 1.0, np.zeros(4, np.float32))])
    assert len(views) == 0
    assert views.fused() is None


def test_two_objects_that_are_one_have_the_views_of_both():
    one = views_of([(frame, 1.0, AXES[0]) for frame in range(0, 200, 2)])
    one.absorb(views_of([(frame, 0.5, AXES[1]) for frame in range(1, 20, 2)]))
    assert len(one) <= MAX_VIEWS
    assert one.frames == sorted(one.frames)
    assert any(frame % 2 for frame in one.frames)
    before = len(one)
    one.add(300, 1.0, AXES[0])
    assert 300 in one.frames
    assert len(one) <= max(before + 1, MAX_VIEWS)


def test_restored_views_continue_identically():
    rng = np.random.default_rng(1)
    rows = [(frame, float(rng.uniform()), rng.normal(size=4)) for frame in range(90)]
    first, whole = views_of(rows[:41]), views_of(rows)
    values = json.loads(json.dumps(first.values()))
    again = ViewEmbeddings.from_values(values, np.array(first.vectors()))
    for row in rows[41:]:
        again.add(*row)
    assert again.values() == whole.values()
    np.testing.assert_array_equal(again.vectors(), whole.vectors())


def embedded(vectors: np.ndarray, model: str = "") -> InstanceMasks:
    ids = of_ids(panel_image()).ids
    return InstanceMasks(ids, [None, None], np.ones(2, np.float32), vectors, model)


def test_objects_have_the_embeddings_of_their_masks():
    tracker = tracked([embedded(AXES[:2])] * 3)
    found = [one.embeddings.fused() for one in tracker.objects.values()]
    np.testing.assert_allclose([one.embedding for one in found], AXES[:2], atol=1e-6)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (
            embedded(np.ones((2, 3), np.float32), "a"),
            r"frame 1 .* length 3 \(a\), .* length 4 \(a\)",
        ),
        (embedded(AXES[:2], "b"), r"length 4 \(b\)"),
    ],
)
def test_embeddings_of_two_models_are_refused_after_resuming_too(second, message):
    first = InstanceTracker(InstanceOptions(), Scripted([embedded(AXES[:2], "a")]))
    first.update(0, [keyframe(0)])
    again = InstanceTracker(InstanceOptions(), Scripted([None, second]))
    arrays, values = first.state()
    again.restore(arrays, json.loads(json.dumps(values)))
    with pytest.raises(DatasetError, match=message):
        again.update(0, [keyframe(0), keyframe(1)])
