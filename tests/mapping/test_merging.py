"""Spheres become ellipsoids at the end of a run."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from mapped_room import depth_error_m, fed, psnr_db
from mapped_submap import MappedSubmap

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.merging import PATCH_PX, to_ellipsoids
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud

_FOCAL, _DEPTH_M = 100.0, 2.0
# Side of a patch at this depth: a power of two.
_SIDE_M = 2.0 ** round(math.log2(PATCH_PX * _DEPTH_M / _FOCAL))


def submap_of(means: torch.Tensor, colours: torch.Tensor, radius_m: float = 0.004) -> Submap:
    """Spheres that a keyframe at the origin seeded."""
    n = len(means)
    cloud = GaussianCloud.from_values(
        means, torch.full((n,), radius_m), torch.full((n,), 0.5), colours, torch.ones(n, 2)
    )
    camera = Camera(_FOCAL, _FOCAL, 319.5, 239.5, 640, 480)
    keyframe = Keyframe(
        index=3,
        timestamp_s=0.0,
        T_map_camera=np.eye(4),
        rgb=torch.zeros(3, 12, 16, dtype=torch.uint8),
        depth_m=torch.full((12, 16), _DEPTH_M),
        camera=camera,
        exposure=IDENTITY,
        points=torch.zeros(0, 3),
    )
    seeded_by = torch.full((n,), 3, dtype=torch.int32)
    return Submap(0, np.eye(4), cloud, [keyframe], seeded_by)


def patch(count: int = 200, seed: int = 0) -> torch.Tensor:
    """Centres [N, 3] within one patch, on a plane of constant z."""
    inside = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed))
    flat = (0.02 + 0.96 * inside) * _SIDE_M
    return torch.cat([flat, torch.full((count, 1), _DEPTH_M + 0.01)], dim=1)


def grey(count: int) -> torch.Tensor:
    return torch.full((count, 3), 0.55)


def test_a_patch_of_a_wall_becomes_one_flat_ellipsoid() -> None:
    submap = submap_of(patch(), grey(200))
    to_ellipsoids(submap, torch.zeros(200, dtype=torch.int64))
    cloud = submap.gaussians
    assert len(cloud) == 1 and cloud.ellipsoids is not None
    scales = cloud.ellipsoids.log_scales.exp()[0].sort().values
    assert float(scales[0]) == pytest.approx(0.004, rel=1e-3)
    assert float(scales[1]) > 3 * 0.004
    torch.testing.assert_close(cloud.means[0], patch().mean(dim=0), atol=1e-5, rtol=0)
    torch.testing.assert_close(cloud.colours, grey(1))
    torch.testing.assert_close(cloud.opacities, torch.tensor([0.5]))
    assert cloud.features.tolist() == [[1, 1]]
    assert cloud.ellipsoids.harmonics.shape == (1, 0, 3)
    assert submap.seeded_by.tolist() == [3]
    assert len(submap.optimiser.steps) == 1


@pytest.mark.parametrize("kind", ["colours", "places"])
def test_what_differs_stays_apart(kind: str) -> None:
    means, colours = patch(), grey(200)
    half = torch.arange(200) % 2 == 0
    if kind == "colours":
        colours[half] = 0.2
    else:
        means[half, 0] += _SIDE_M
    submap = submap_of(means, colours)
    to_ellipsoids(submap, torch.zeros(200, dtype=torch.int64))
    assert len(submap.gaussians) == 2


def test_patches_across_a_border_of_classes_are_halved() -> None:
    beside = patch(seed=1) + torch.tensor([_SIDE_M, 0.0, 0.0])
    means = torch.cat([patch(), beside])
    classes = torch.full((400,), 4)
    classes[:200][means[:200, 0] < _SIDE_M / 2] = 0
    submap = submap_of(means, grey(400))
    to_ellipsoids(submap, classes)
    x_m = submap.gaussians.means[:, 0]
    assert int((x_m > _SIDE_M).sum()) == 1, "no border"
    assert int((x_m < _SIDE_M).sum()) == 4, "two for each class"


def test_a_single_sphere_stays_a_sphere() -> None:
    submap = submap_of(torch.tensor([[0.1, 0.2, 2.0]]), grey(1))
    to_ellipsoids(submap, torch.zeros(1, dtype=torch.int64))
    shapes = submap.gaussians.ellipsoids
    assert shapes is not None
    torch.testing.assert_close(shapes.log_scales.exp(), torch.full((1, 3), 0.004))


def test_an_empty_submap_stays_empty() -> None:
    submap = submap_of(torch.zeros(0, 3), grey(0))
    to_ellipsoids(submap, torch.zeros(0, dtype=torch.int64))
    assert len(submap.gaussians) == 0


def test_patches_of_small_images_are_smaller() -> None:
    submap = submap_of(patch(), grey(200))
    submap.keyframes[0].camera = Camera(_FOCAL, _FOCAL, 79.5, 59.5, 160, 120)
    to_ellipsoids(submap, torch.zeros(200, dtype=torch.int64))
    assert len(submap.gaussians) == 4


def test_ellipsoids_show_a_room_as_well_as_spheres(room) -> None:
    found = {}
    for shape in ("spheres", "ellipsoids"):
        mapper = fed(MappedSubmap(MapperOptions(final_shape=shape)), room, range(0, 12, 3))
        mapper.refine()
        image = room.frames[4], room.T_map_camera[4]
        error = np.median(np.abs(depth_error_m(mapper, *image)))
        found[shape] = len(mapper.gaussians), psnr_db(mapper, *image), error
    spheres, ellipsoids = found["spheres"], found["ellipsoids"]
    assert ellipsoids[0] < spheres[0]
    assert ellipsoids[1] > spheres[1]
    assert ellipsoids[2] < spheres[2] + 0.002


def test_without_refinement_spheres_remain(room) -> None:
    options = MapperOptions(final_shape="ellipsoids", final_iterations=0)
    mapper = fed(MappedSubmap(options), room, range(0, 6, 3))
    mapper.refine()
    assert mapper.gaussians.ellipsoids is None


def test_a_stored_submap_of_ellipsoids_is_restored(room) -> None:
    mapper = fed(MappedSubmap(MapperOptions(final_shape="ellipsoids")), room, range(0, 6, 3))
    mapper.refine()
    submap = mapper.submap
    restored = Submap.from_state(*submap.state())
    assert restored.gaussians.low_pass == submap.gaussians.low_pass
    for name, tensor in submap.gaussians.tensors().items():
        assert torch.equal(restored.gaussians.tensors()[name], tensor), name


def test_spheres_can_be_added_to_ellipsoids(room) -> None:
    mapper = fed(MappedSubmap(MapperOptions(final_shape="ellipsoids")), room, range(0, 6, 3))
    mapper.refine()
    submap = mapper.submap
    before = len(submap.gaussians)
    seeds = submap_of(patch(5), grey(5)).gaussians
    seeds = GaussianCloud.from_values(seeds.means, seeds.radii_m, seeds.opacities, seeds.colours)
    submap.append(seeds, submap.keyframes[0])
    assert submap.gaussians.ellipsoids is not None
    assert len(submap.gaussians.ellipsoids) == before + 5
    submap.remove(torch.arange(before + 5) < before)
    assert len(submap.gaussians) == 5
