"""Objects of finished maps pass on to later maps by the positions of their Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from panels import Scripted, keyframe, panel_image

from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.result import MapObject
from toolkit.scene.instances.saved import SavedObjects, joined
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.embedding_fusion import FusedEmbedding

MOVED = np.eye(4)
MOVED[:3, 3] = [0.5, -0.25, 1.0]


def fused(*values: float) -> FusedEmbedding:
    vector = np.array(values, np.float32) / np.linalg.norm(values)
    return FusedEmbedding(vector.astype(np.float32), 2.0, np.ones(1, bool), 1.0)


def panels(numbers: tuple[int, int], submap: int = 0, model: str = "a") -> SavedObjects:
    """Two squares side by side, of 400 Gaussians each."""
    x, y = np.meshgrid(np.linspace(-0.98, 0.98, 40), np.linspace(0, 0.95, 20))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    ids = np.where(points[:, 0] < 0, numbers[0], numbers[1]).astype(np.int32)
    objects = [
        MapObject(n, name, 400, 0.5, 4, 3, 9, fused(1.0, k))
        for k, (n, name) in enumerate(zip(numbers, ("chair", "table"), strict=True))
    ]
    objects.sort(key=lambda one: one.number)
    return SavedObjects(objects, points, ids, np.full(len(ids), submap, np.int32), model)


def test_moved_gaussians_keep_their_objects():
    saved = panels((1, 2))
    rng = np.random.default_rng(0)
    order = rng.permutation(len(saved.ids))
    points = saved.points_m[order] + rng.normal(0.0, 0.002, (len(order), 3)) + MOVED[:3, 3]
    back = np.linalg.inv(MOVED)
    np.testing.assert_array_equal(saved.of(0, points, back), saved.ids[order])
    assert not saved.of(0, points + 9.0, back).any()
    assert not saved.of(1, points, back).any()  # another submap
    assert len(saved.of(0, np.zeros((0, 3)))) == 0


def test_loaded_submaps_have_the_objects_of_their_map():
    tracker = InstanceTracker(InstanceOptions(), None)
    tracker.load(panels((4, 9)), 0)
    points = panels((4, 9)).points_m - MOVED[:3, 3]
    found = tracker.of_points(0, points, MOVED)
    np.testing.assert_array_equal(found, panels((4, 9)).ids)
    assert tracker.of_points(1, points, MOVED) is None
    np.testing.assert_allclose(tracker.embeddings(np.array([0, 9]))[9], fused(1.0, 1).embedding)


def test_carried_objects_are_counted_anew_and_those_without_gaussians_are_gone():
    saved = panels((3, 5))
    found = saved.carried({0: np.full(7, 5, np.int32), 2: np.array([0, 5], np.int32)})
    assert [(one.number, one.gaussians, one.class_name) for one in found.objects] == [
        (5, 8, "table")
    ]
    assert found.model == "a"


def test_objects_of_separate_parts_remain_where_these_do():
    saved = panels((3, 5))
    alone = MapObject(9, "lamp", 40, 0.5, 4, 3, 9)
    saved = replace(saved, objects=[*saved.objects, alone])
    ids = {0: np.full(7, 5, np.int32)}
    numbers = [one.number for one in saved.carried(ids, separate_parts=True).objects]
    assert numbers == [5, 9]
    assert [one.number for one in saved.carried(ids).objects] == [5]


@pytest.mark.parametrize("shift_m", [0.0, 40.0])
def test_objects_of_two_maps_are_one_where_they_overlap(shift_m):
    a, b = panels((1, 2)), panels((2, 1), submap=7)
    T_a_b = np.eye(4)
    T_a_b[0, 3] = shift_m
    found = joined(a, b, T_a_b)
    numbers = [one.number for one in found.objects]
    assert numbers == ([1, 2] if shift_m == 0.0 else [1, 2, 3, 4])
    own = found.ids[found.submap == 7]
    if shift_m == 0.0:
        np.testing.assert_array_equal(own, a.ids)
        assert [one.views for one in found.objects] == [8, 8]
        assert [one.class_name for one in found.objects] == ["chair", "table"]
    else:
        assert set(own.tolist()) == {3, 4}
        np.testing.assert_allclose(found.points_m[-1] - b.points_m[-1], [shift_m, 0, 0])


def test_embeddings_of_two_models_are_not_mixed():
    found = joined(panels((1, 2)), panels((1, 2), 7, "b"), np.eye(4))
    assert found.model == ""
    assert all(one.embedding is None for one in found.objects)
    found = joined(panels((1, 2)), panels((1, 2), 7), np.eye(4))
    assert found.model == "a"
    np.testing.assert_allclose(found.objects[1].embedding.embedding, [0.7071, 0.7071], atol=1e-3)


def test_a_loaded_object_survives_a_checkpoint_with_its_number():
    tracker = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 2))
    tracker.load(panels((4, 6)), -100)
    tracker.update(0, [keyframe(0)])
    assert sorted(tracker.objects) == [4, 6, 7, 8]
    arrays, values = tracker.state()
    again = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 2))
    again.restore({k: np.array(a) for k, a in arrays.items()}, values)
    assert again.saved is not None
    np.testing.assert_array_equal(again.saved.ids, panels((4, 6)).ids)
    assert again.objects[4].class_name == "chair"
    assert (again.objects[4].first, again.objects[4].mean_score) == (-97, 0.5)
    assert again.embedded == (2, "a")


def test_without_masks_and_a_loaded_map_there_is_nothing_to_do():
    tracker = InstanceTracker(InstanceOptions(), None)
    tracker.update(0, [keyframe(0)])
    assert tracker.is_idle
    tracker.load(panels((1, 2)), 0)
    assert not tracker.is_idle
