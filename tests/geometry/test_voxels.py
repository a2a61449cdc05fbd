"""Numbers of voxels."""

import numpy as np

from toolkit.base.geometry.voxels import voxel_keys, voxels_of, voxels_of_keys


def test_points_are_in_their_voxels():
    points = np.array([[0.05, -0.01, 0.1], [-0.31, 0.0, 2.0]])
    assert voxels_of(points, 0.1).tolist() == [[0, -1, 1], [-4, 0, 20]]


def test_numbers_are_unique_ordered_and_invertible():
    steps = np.arange(-2, 3)
    voxels = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    far = np.array([[-(1 << 20), (1 << 20) - 1, 7]])
    for coordinates in (voxels, far):
        assert voxels_of_keys(voxel_keys(coordinates)).tolist() == coordinates.tolist()
    assert (np.diff(voxel_keys(voxels)) > 0).all()
