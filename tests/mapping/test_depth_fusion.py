"""Centres that follow what keyframes measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.slam.mapping import depth_fusion
from toolkit.slam.mapping.depth_fusion import MeasuredCentres, fuse_depth, measured_centres
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud

CAMERA = Camera(width=40, height=30, fx=40.0, fy=40.0, cx=19.5, cy=14.5)
WALL_M = 4.0


def keyframe(index: int, z: float = 0.0, slope: float = 0.0) -> Keyframe:
    """A camera at height z before the plane `Z = WALL_M + slope X`, looking along Z."""
    rays = CAMERA.rays()
    depth = (WALL_M - z) / (1.0 - slope * rays[..., 0])
    frame = Frame(
        index=index,
        timestamp_s=float(index),
        rgb=np.full((30, 40, 3), 0.5, np.float32),
        depth_m=depth.astype(np.float32),
        camera=CAMERA,
    )
    T = np.eye(4)
    T[2, 3] = z
    return Keyframe.from_frame(frame, T)


def at(*centres: tuple[float, float, float]) -> GaussianCloud:
    count = len(centres)
    return GaussianCloud(
        means=torch.tensor(centres),
        log_radii=torch.full((count,), -4.0),
        opacity_logits=torch.full((count,), 3.0),
        colours=torch.full((count, 3), 0.5),
        features=torch.zeros(count, 0),
    )


def seen(cloud: GaussianCloud, *keyframes: Keyframe) -> MeasuredCentres:
    """By the last of these; all were measured by the first."""
    first = torch.full((len(cloud),), keyframes[0].index, dtype=torch.int32)
    return measured_centres(cloud, first, keyframes, keyframes[-1].depth_m)


def test_from_as_far_as_before_it_goes_a_fifth_of_the_way():
    found = seen(at((0.3, 0.2, WALL_M + 0.05)), keyframe(3), keyframe(7))
    assert found.indices.tolist() == [0] and not found.replaced.any()
    ray = np.array([0.3, 0.2, WALL_M + 0.05])
    surface = ray * WALL_M / ray[2]
    np.testing.assert_allclose(found.centres[0], ray + 0.2 * (surface - ray), atol=1e-5)


def test_from_half_as_far_it_is_measured_anew():
    eye = np.array([0.0, 0.0, 2.0])
    found = seen(at((0.3, 0.2, WALL_M + 0.05)), keyframe(3), keyframe(7, z=2.0))
    assert found.replaced.tolist() == [True]
    ray = np.array([0.3, 0.2, WALL_M + 0.05]) - eye
    np.testing.assert_allclose(found.centres[0], eye + ray * 2.0 / ray[2], atol=1e-5)


def test_from_far_away_nothing_new_is_learned():
    found = seen(at((0.3, 0.2, WALL_M + 0.05)), keyframe(3, z=2.5), keyframe(7))
    assert len(found.indices) == 0


@pytest.mark.parametrize(
    "centre",
    [(0.3, 0.2, WALL_M - 0.3), (0.3, 0.2, WALL_M + 0.3), (5.0, 0.0, WALL_M), (0.0, 0.0, -1.0)],
    ids=["before the wall", "behind it", "outside the view", "behind the camera"],
)
def test_what_is_not_on_the_surface_stays(centre):
    assert len(seen(at(centre), keyframe(3), keyframe(7)).indices) == 0


def test_a_slanted_wall_is_not_bent():
    """Between pixels inverse depth is linear; depth itself is not."""
    x = np.linspace(-1.0, 1.0, 40)
    centres = [(float(a), 0.11, WALL_M + 0.5 * float(a)) for a in x]
    found = seen(at(*centres), keyframe(3, slope=0.5), keyframe(7, slope=0.5))
    assert len(found.indices) > 30
    off = found.centres[:, 2] - (WALL_M + 0.5 * found.centres[:, 0])
    assert off.abs().max() < 1e-5


def test_at_an_edge_of_depth_nothing_moves():
    step = keyframe(7)
    step.depth_m[:, 20:] = 2.0
    centres = [((u - 19.5) / 40.0 * WALL_M, 0.0, WALL_M + 0.05) for u in (10.5, 19.5)]
    assert seen(at(*centres), keyframe(3), step).indices.tolist() == [0]


def test_missing_depth_moves_nothing():
    blind = replace(keyframe(7), depth_m=torch.zeros(30, 40))
    assert len(seen(at((0.3, 0.2, WALL_M)), keyframe(3), blind).indices) == 0


def test_an_empty_map_is_measured_too():
    assert len(seen(GaussianCloud.empty(0), keyframe(3)).indices) == 0


def test_a_noisy_wall_becomes_thinner(room):
    """The same view again and again, each time with noise of its own."""
    generator = np.random.default_rng(0)
    like, pose = room.frames[0], np.eye(4)
    thickness_m = {}
    for fuse in (True, False):
        mapper = MappedSubmap(MapperOptions(first_iterations=0, iterations=0, fuse_depth=fuse))
        for index in range(8):
            noise = generator.normal(0.0, 0.004, like.depth_m.shape).astype(np.float32)
            flat = np.where(like.depth_m > 0, 2.0 + noise, 0.0).astype(np.float32)
            mapper.add_keyframe(Keyframe.from_frame(replace(like, index=index, depth_m=flat), pose))
        thickness_m[fuse] = float(mapper.gaussians.means[:, 2].std())
    assert thickness_m[True] < 0.6 * thickness_m[False]


def test_gaussians_measured_anew_belong_to_the_newest_keyframe(room):
    frame, nearer = room.frames[0], np.eye(4)
    nearer[2, 3] = 1.0
    mapper = MappedSubmap(MapperOptions(first_iterations=0, iterations=0))
    mapper.add_keyframe(Keyframe.from_frame(frame, np.eye(4)))
    assert (mapper.submap.seeded_by == frame.index).all()
    closer = replace(frame, index=9, depth_m=np.maximum(frame.depth_m - 1.0, 0.0))
    count = len(mapper.gaussians)
    mapper.add_keyframe(Keyframe.from_frame(closer, nearer))
    seeded_by = mapper.submap.seeded_by[:count]
    assert (seeded_by == 9).any()
    assert (seeded_by == frame.index).any()


@pytest.mark.parametrize("name", available_instruction_sets())
def test_the_kernel_agrees_with_torch(name: str, monkeypatch: pytest.MonkeyPatch):
    generator = np.random.default_rng(0)
    views = [keyframe(index, z, slope=0.3) for index, z in ((3, 0.0), (5, -3.0), (8, 2.0))]
    views[-1].depth_m[5:9, 7:20] = 0.0
    means = generator.uniform((-3, -2, -1), (3, 2, 5), (5000, 3))
    means[::2, 2] = WALL_M + 0.3 * means[::2, 0] + generator.normal(0.0, 0.05, 2500)
    cloud = at(*means.astype(np.float32).tolist())
    seeded_by = torch.from_numpy(generator.choice([3, 4, 5, 8], len(cloud)).astype(np.int32))
    found = []
    for variant in (None, load_variant(name)):
        monkeypatch.setattr(depth_fusion, "kernels_for", lambda _, variant=variant: variant)
        fused = Submap(0, np.eye(4), cloud, views, seeded_by)
        fuse_depth(fused, views[-1].depth_m)
        found.append((fused.gaussians.means, fused.seeded_by))
    (expected, expected_by), (moved, moved_by) = found
    assert torch.equal(cloud.means, torch.tensor(means.astype(np.float32)))
    changed = (expected != cloud.means).any(dim=1)
    assert 0.02 < changed.float().mean() < 0.9 and int((expected_by != seeded_by).sum()) > 100
    # Rounding may move a point into another cell of the image, or across a limit.
    differs = ~torch.isclose(expected, moved, rtol=1e-5, atol=1e-5).all(dim=1)
    assert int((differs | (expected_by != moved_by)).sum()) < 5
