"""Masks of single views become persistent objects."""

from __future__ import annotations

import json

import numpy as np
import pytest
from panels import LEFT, RIGHT, Scripted, current_objects, keyframe, panel_image, tracked

from toolkit.scene.instances.joining import join_parts, join_submaps
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.scene.instances.voxels import MaskedVoxels, VoxelVotes

SHIFTS = [0.1 * k - 0.3 for k in range(7)]


def shuffled(image: np.ndarray, seed: int) -> np.ndarray:
    """The same masks with other ids."""
    ids = np.random.default_rng(seed).permutation(50)[:2] + 1
    return np.select([image == LEFT, image == RIGHT], ids, 0)


def one(image: np.ndarray) -> np.ndarray:
    """One mask for both panels."""
    return np.where(image > 0, 7, 0)


def test_ids_that_restart_in_every_frame_are_the_same_objects():
    images = [shuffled(panel_image(shift), k) for k, shift in enumerate(SHIFTS)]
    tracker = tracked(images, SHIFTS)
    assert len(tracker.objects) == 2
    assert [one.views for one in tracker.objects.values()] == [7, 7]
    for image, record in zip(images, tracker.records, strict=True):
        left_first = image[0, 0] < image[0, -1]
        assert record.objects.tolist() == (
            tracker.records[0].objects.tolist()
            if left_first == (images[0][0, 0] < images[0][0, -1])
            else tracker.records[0].objects.tolist()[::-1]
        )


def test_points_of_a_submap_have_the_objects_of_their_voxels_so_far():
    tracker = tracked([panel_image()] * 2)
    points_m = np.array([[-0.5, 0.1, 2.0], [0.5, 0.1, 2.0], [0.5, 0.1, 9.0]])
    left, right, nothing = tracker.of_points(0, points_m, np.eye(4)).tolist()
    mask = panel_image()[0]
    assert [left, right] == [current_objects(tracker, 0)[mask[x] - 1] for x in (0, -1)]
    assert nothing == 0
    assert tracker.of_points(1, points_m, np.eye(4)) is None


def test_a_mask_of_two_known_objects_does_not_merge_them():
    images = [panel_image()] * 4 + [one(panel_image())] + [panel_image()] * 2
    tracker = tracked(images)
    assert len(tracker.objects) == 2
    assert current_objects(tracker, 0) == current_objects(tracker, 6)


def test_objects_that_are_hardly_seen_apart_are_merged():
    tracker = tracked([panel_image()] + [one(panel_image())] * 5)
    assert len(tracker.objects) == 1
    assert len(set(current_objects(tracker, 0))) == 1


def test_an_object_is_split_where_two_masks_see_it_again_and_again():
    tracker = tracked([one(panel_image())] * 2 + [panel_image()] * 8)
    join_parts(tracker)
    assert len(tracker.objects) == 2
    assert len(set(current_objects(tracker, 9))) == 2


def test_a_part_that_was_seen_once_returns_to_its_object():
    tracker = tracked([one(panel_image())] * 3 + [panel_image()] + [one(panel_image())])
    join_parts(tracker)
    assert len(tracker.objects) == 1


def test_a_missing_frame_changes_nothing():
    images = [panel_image(), None, np.zeros((120, 160), int), panel_image()]
    tracker = tracked(images)
    assert [one.views for one in tracker.objects.values()] == [2, 2]


def test_a_view_without_depth_changes_nothing():
    tracker = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 3))
    views = [keyframe(index) for index in range(3)]
    views[0].depth_m *= 0.0
    views[2].depth_m *= 0.0
    for count in range(1, 4):
        tracker.update(0, views[:count])
    assert [one.views for one in tracker.objects.values()] == [1, 1]


def masks(image: np.ndarray, classes: list, embeddings: np.ndarray) -> InstanceMasks:
    return InstanceMasks(
        image.astype(np.int32), classes, np.ones(2, np.float32), embeddings.astype(np.float32)
    )


def test_embeddings_decide_where_overlap_does_not():
    # The border lies so that the second view of the objects overlaps both alike.
    first = masks(panel_image(), [None, None], np.eye(2))
    middle = np.zeros((120, 160), int)
    middle[:, 40:120] = 1
    as_left = masks(middle, [None, None], np.array([[1, 0], [0, 1]]))
    as_right = masks(middle, [None, None], np.array([[0, 1], [1, 0]]))
    found = [current_objects(tracked([first, second]), 1)[0] for second in (as_left, as_right)]
    assert found == [1, 2]


def test_the_class_of_an_object_is_that_of_most_of_its_masks():
    named = [masks(panel_image(), [name, None], np.zeros((2, 0))) for name in ("a", "b", "b")]
    tracker = tracked(named)
    assert [one.class_name for one in tracker.objects.values()] == ["b", None]


def test_a_restored_tracker_continues_identically():
    rng = np.random.default_rng(0)
    images = [
        masks(panel_image(shift), ["chair", None], rng.normal(size=(2, 4))) for shift in SHIFTS
    ]
    images[2] = one(panel_image(SHIFTS[2]))
    whole = tracked(images, SHIFTS)
    first = tracked(images[:4], SHIFTS[:4])
    arrays, values = first.state()
    arrays = {name: np.array(array) for name, array in arrays.items()}
    again = InstanceTracker(InstanceOptions(), Scripted(images))
    again.restore(arrays, json.loads(json.dumps(values)))
    again.update(0, [keyframe(k, shift) for k, shift in enumerate(SHIFTS)])
    (arrays, values), (expected, expected_values) = again.state(), whole.state()
    assert values == expected_values
    assert arrays.keys() == expected.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def test_a_submap_that_starts_with_a_keyframe_of_another_one_sees_its_masks():
    tracker = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 2))
    tracker.update(0, [keyframe(0)])
    tracker.update(1, [keyframe(0), keyframe(1)])
    assert [(record.submap, record.index) for record in tracker.records] == [(0, 0), (1, 0), (1, 1)]
    assert [one.submap for one in tracker.objects.values()] == [0, 0, 1, 1]


@pytest.mark.parametrize(("moved_m", "count"), [(0.0, 2), (5.0, 4)])
def test_objects_of_two_submaps_are_one_where_they_overlap_in_the_world(moved_m, count):
    tracker = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 2))
    tracker.update(0, [keyframe(0)])
    tracker.update(1, [keyframe(1)])
    votes = {}
    for submap, record in enumerate(tracker.records):
        votes[submap] = VoxelVotes(0.04)
        pose = np.eye(4)
        pose[0, 3] = moved_m * submap
        view = keyframe(submap)
        seen = MaskedVoxels.of(record.ids, view.depth_m.numpy(), view.camera, pose, 0.04)
        votes[submap].add(seen.keys, record.objects[seen.mask - 1])
    join_submaps(tracker, votes)
    assert len(tracker.objects) == count


def test_noise_of_the_depth_does_not_double_objects():
    tracker = InstanceTracker(InstanceOptions(), Scripted([panel_image()] * 6))
    rng = np.random.default_rng(0)
    keyframes = []
    for index in range(6):
        view = keyframe(index)
        view.depth_m += view.depth_m.new_tensor(rng.normal(0.0, 0.015, (120, 160)))
        keyframes.append(view)
        tracker.update(0, keyframes)
    assert len(tracker.objects) == 2
