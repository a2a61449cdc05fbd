"""Voxels of masks, and votes for objects in voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from panels import CAMERA, keyframe, panel_image

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.scene.instances.geometric import GeometricMasks
from toolkit.scene.instances.voxels import MaskedVoxels, VoxelVotes, sampled, sampling_step


def votes_of(rounds: list[list[tuple[int, int]]]) -> VoxelVotes:
    votes = VoxelVotes(0.04)
    for entries in rounds:
        keys, objects = (np.array(column) for column in zip(*sorted(entries), strict=True))
        votes.add(keys.astype(np.int64), objects.astype(np.int32))
    return votes


def test_the_voxels_of_a_view_are_those_of_its_points():
    view, image = keyframe(0), panel_image()
    seen = MaskedVoxels.of(image, view.depth_m.numpy(), CAMERA, view.T_map_camera, 0.04)
    points = CAMERA.unproject(view.depth_m.numpy()).reshape(-1, 3)
    keys = voxel_keys(voxels_of(points, 0.04))
    np.testing.assert_array_equal(seen.keys, np.unique(keys))
    for key, mask in zip(seen.keys, seen.mask, strict=True):
        counts = np.bincount(image.reshape(-1)[keys == key], minlength=3)
        assert counts[mask] == counts.max()
    assert (voxel_keys(voxels_of(seen.points, 0.04)) == seen.keys).all()


def test_a_view_without_depth_has_no_voxels():
    view = keyframe(0)
    seen = MaskedVoxels.of(panel_image(), 0 * view.depth_m.numpy(), CAMERA, np.eye(4), 0.04)
    assert len(seen) == 0


def test_the_object_with_most_votes_owns_a_voxel():
    votes = votes_of([[(5, 1), (9, 2)], [(5, 2), (9, 2)], [(5, 2)], [(7, 3)]])
    assert votes.keys.tolist() == [5, 9, 7]
    assert votes.owners.tolist() == [[2, 1], [2, 0], [3, 0]]
    assert votes.votes.tolist() == [[2, 1], [2, 0], [1, 0]]


def test_all_voxels_are_found_however_many_there_are():
    rng = np.random.default_rng(0)
    keys = rng.permutation(60_000)[:40_000]
    votes = VoxelVotes(0.04)
    for part in np.split(keys, 10):
        votes.add(part, (part % 7 + 1).astype(np.int32))
    rows = votes.rows(np.arange(60_000))
    np.testing.assert_array_equal(np.flatnonzero(rows >= 0), np.sort(keys))
    np.testing.assert_array_equal(votes.keys[rows[keys]], keys)
    np.testing.assert_array_equal(votes.owners[rows[keys], 0], keys % 7 + 1)


@given(st.lists(st.integers(1, 4), min_size=1, max_size=30))
@settings(max_examples=60)
def test_an_object_with_most_of_all_votes_is_the_owner(objects):
    votes = votes_of([[(0, number)] for number in objects])
    counts = np.bincount(objects)
    if len(objects) <= 8 and counts.max() > len(objects) / 2:
        assert votes.owners[0, 0] == counts.argmax()
    assert votes.votes[0, 0] >= votes.votes[0, 1] >= 0


def test_merged_objects_share_their_votes():
    votes = votes_of([[(1, 1), (2, 2)], [(1, 2), (2, 3)]])
    votes.relabel(np.array([0, 1, 1, 0], np.int32))
    assert votes.owners.tolist() == [[1, 0], [1, 0]]
    assert votes.votes.tolist() == [[2, 0], [1, 0]]


def test_a_point_outside_all_voxels_has_no_owner():
    assert VoxelVotes(0.04).owner_at(np.zeros((2, 3))).tolist() == [0, 0]
    key = int(voxel_keys(voxels_of(np.zeros((1, 3)), 0.04))[0])
    votes = votes_of([[(key, 4)]])
    assert votes.owner_at(np.array([[0.01, 0.01, 0.01], [1.0, 0, 0]])).tolist() == [4, 0]


@pytest.mark.parametrize("width", [150, 161, 323, 325, 641])
def test_masks_are_sampled_at_the_pixels_of_the_points(width):
    camera = Camera(100.0, 100.0, width / 2, 30.0, width, 67)
    step = sampling_step(width)
    columns = np.broadcast_to(np.arange(width, dtype=np.float32), (67, width))
    # Each point then lies at the column that its mask says.
    points = camera.unproject(np.ones((67, width), np.float32), step)
    pixels = camera.project(points)[..., 0]
    np.testing.assert_allclose(sampled(columns, step), pixels, atol=1e-3)
    masks = GeometricMasks().masks(replace(keyframe(0, shape=(67, width)), camera=camera))
    assert masks is not None and masks.ids.shape == (67, width)


def test_votes_for_known_rows_are_those_for_their_voxels():
    found, given = VoxelVotes(0.04), VoxelVotes(0.04)
    for votes in (found, given):
        votes.add(np.array([5, 9]), np.array([1, 2], np.int32))
    keys, objects = np.array([5, 7, 9]), np.array([3, 3, 2], np.int32)
    found.add(keys, objects)
    given.add(keys, objects, np.array([0, -1, 1], np.int32))
    for name, array in found.state().items():
        np.testing.assert_array_equal(given.state()[name], array)
