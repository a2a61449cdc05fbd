"""A camera in a map of unknown scale: pose and scale from views, and nothing in another room."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.slam.loops.splat_maps.localisation import LocatedFrame, SplatMapLocaliser
from toolkit.slam.loops.splat_maps.views import virtual_keyframe
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import backend

FACTOR = 1.7


@pytest.fixture(scope="module")
def room():
    return tiny_room(5, 160, 120)


@pytest.fixture(scope="module")
def cloud(room) -> GaussianCloud:
    """A map of the first frame, in its coordinates, of another unit of length."""
    frames, _ = room
    mapper = Mapper(MapperOptions(first_iterations=20))
    submap = mapper.first_submap()
    mapper.add_keyframe(submap, Keyframe.from_frame(frames[0], np.eye(4)))
    return submap.gaussians.scaled(FACTOR)


@pytest.fixture(scope="module")
def localiser(room, cloud) -> SplatMapLocaliser:
    camera = room[0][0].camera

    def render(T: np.ndarray) -> Keyframe | None:
        return virtual_keyframe(backend(), cloud, camera, T, 0)

    turned = se3.exp(np.array([0.05, 0.0, -0.05, 0.0, 0.02, 0.4]))
    views = [view for view in (render(turned),) if view is not None]
    return SplatMapLocaliser(cloud, views, render, DenseTracker())


def test_pose_and_scale_are_found(room, localiser):
    frames, truth = room
    found = localiser.locate(frames[4])
    assert isinstance(found, LocatedFrame) and found.index == 4
    assert found.units_per_metre == pytest.approx(FACTOR, rel=0.01)
    T = se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[4]
    np.testing.assert_allclose(found.T_map_camera[:3, 3], FACTOR * T[:3, 3], atol=0.03)
    assert se3.rotation_angle_rad(T[:3, :3].T @ found.T_map_camera[:3, :3]) < 0.01


def test_frames_must_agree(room, localiser):
    frames, _ = room
    assert localiser.located(frames[:1]) == []
    assert [frame.index for frame in localiser.located(frames)] == [0, 1, 2, 3, 4]


def test_another_room_is_not_found(localiser):
    frames, _ = tiny_room(3, 160, 120, seed=5)
    assert localiser.located(frames) == []
