"""What no keyframe shows leaves the finished map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap

from tests.mapping.conftest import MappedRoom
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.hidden_gaussians import hidden
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering import backend

CAMERA = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)


def keyframe(x_m: float = 0.0) -> Keyframe:
    images = np.full((30, 40, 3), 0.5, np.float32), np.full((30, 40), 2.0, np.float32)
    T = np.eye(4)
    T[0, 3] = x_m
    return Keyframe.from_frame(Frame(0, 0.0, *images, CAMERA), T)


def cloud(*centres_and_radii: tuple[float, float, float, float]) -> GaussianCloud:
    values = torch.tensor(centres_and_radii)
    count = len(values)
    black = torch.zeros(count, 3)
    return GaussianCloud.from_values(values[:, :3], values[:, 3], torch.full((count,), 0.99), black)


# A screen, a Gaussian of the wall behind it, one beside it, one of a tenth of a pixel, one behind
# the wall, and one behind the camera.
SCENE = cloud(
    (0.0, 0.0, 1.0, 0.5),
    (0.0, 0.0, 2.0, 0.05),
    (0.8, 0.0, 2.0, 0.1),
    (-0.8, 0.0, 2.0, 0.003),
    (0.0, 0.0, 3.0, 0.05),
    (0.0, 0.0, -1.0, 0.3),
)


@pytest.mark.parametrize("name", ["native", "reference"])
def test_covered_and_tiny_gaussians_are_hidden_whatever_their_colour(name):
    mask = hidden(SCENE, [keyframe()], backend(name))
    assert mask.tolist() == [False, True, False, True, False, False]


def test_one_keyframe_that_shows_a_gaussian_suffices():
    mask = hidden(SCENE, [keyframe(), keyframe(0.7)], backend("auto"))
    assert mask.tolist() == [False, False, False, True, False, False]
    assert not hidden(SCENE, [], backend("auto")).any()


def test_ellipsoids_hide_as_much_whatever_their_harmonics():
    shapes = Ellipsoids(
        SCENE.log_radii[:, None].expand(-1, 3).clone(),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(6, -1).clone(),
        torch.full((6, 3, 3), -2.0),
    )
    mask = hidden(replace(SCENE, ellipsoids=shapes), [keyframe()], backend("auto"))
    assert mask.tolist() == [False, True, False, True, False, False]


@pytest.mark.parametrize("shape", ["spheres", "ellipsoids"])
def test_a_refined_map_has_no_hidden_gaussians(room: MappedRoom, shape: str):
    mapper = MappedSubmap(MapperOptions(first_iterations=5, final_iterations=2, final_shape=shape))
    for frame, T in list(zip(room.frames, room.T_map_camera, strict=False))[:2]:
        mapper.add_keyframe(Keyframe.from_frame(frame, T))
    mapper.refine()
    assert not hidden(mapper.gaussians, mapper.keyframes, backend("auto")).any()
