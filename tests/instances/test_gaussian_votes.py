"""Every Gaussian gets the object that the keyframes see at its place."""

from __future__ import annotations

import numpy as np
import pytest
from panels import CAMERA, DISTANCE_M, LEFT, RIGHT, keyframe, panel_image

from toolkit.scene.instances.records import KeyframeMasks, records_state, restored_records
from toolkit.scene.instances.voting import GaussianVotes, MaskedKeyframe
from toolkit.scene.instances.voxels import VoxelVotes

OBJECTS = np.array([LEFT, RIGHT], np.int32)


def masked(image: np.ndarray, objects: np.ndarray = OBJECTS) -> MaskedKeyframe:
    record = KeyframeMasks.of(0, 0, objects, image)
    return MaskedKeyframe(keyframe(0), np.eye(4), record, objects)


def winners(points: list, images: list[np.ndarray], kept: np.ndarray | None = None) -> list[int]:
    votes = GaussianVotes(np.array(points, float), VoxelVotes(0.04), 2)
    for image in images:
        votes.add(masked(image))
    return votes.winners(kept).tolist()


def test_visible_gaussians_take_the_object_of_most_views():
    points = [[-0.5, 0, DISTANCE_M], [0.5, 0, DISTANCE_M]]
    wrong = np.full((120, 160), LEFT)
    assert winners(points, [panel_image(), panel_image(), wrong]) == [LEFT, RIGHT]


@pytest.mark.parametrize("z", [1.5, 2.5, -2.0])
def test_hidden_gaussians_and_those_in_front_have_no_object(z):
    assert winners([[-0.5, 0, z], [-0.5, 0, DISTANCE_M]], [panel_image()]) == [0, LEFT]


def test_gaussians_beside_a_mask_belong_to_its_object():
    image = panel_image()
    image[:, 60:] = 0
    x = (np.array([59.0, 60.0, 100.0]) - CAMERA.cx) / CAMERA.fx * DISTANCE_M
    assert winners([[value, 0, DISTANCE_M] for value in x], [image]) == [LEFT, LEFT, 0]


def test_an_object_that_is_not_kept_has_no_gaussians():
    points = [[-0.5, 0, DISTANCE_M], [0.5, 0, DISTANCE_M]]
    kept = np.array([False, False, True])
    assert winners(points, [panel_image()], kept) == [0, RIGHT]


def test_a_mask_of_two_objects_leaves_gaussians_to_their_voxels():
    both = np.full((120, 160), 1)
    x = (np.arange(160) - CAMERA.cx) / CAMERA.fx * DISTANCE_M
    points = np.stack([x, np.zeros(160), np.full(160, DISTANCE_M)], axis=1)
    voxels = VoxelVotes(0.04)
    first = masked(panel_image()).seen(0.04)
    voxels.add(first.keys, first.mask)
    votes = GaussianVotes(points, voxels, 2)
    votes.add(masked(both, np.array([LEFT], np.int32)))
    found = votes.winners()
    assert (found == np.where(x < 0, LEFT, RIGHT)).mean() > 0.97


def test_records_are_restored():
    records = [
        KeyframeMasks.of(3, 1, OBJECTS, panel_image()),
        KeyframeMasks.of(9, 2, OBJECTS[:1], np.zeros((2, 3), int)),
    ]
    again = restored_records(records_state(records))
    assert [(r.index, r.submap, r.shape) for r in again] == [(3, 1, (120, 160)), (9, 2, (2, 3))]
    for one, other in zip(records, again, strict=True):
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_array_equal(one.objects, other.objects)
