"""Fusion of submaps without duplicated surfaces."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.refinement.fusion import fuse_submaps, single_submap
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import render


def wall(number, left_m, right_m, steps, colour=0.5):
    """A wall at z = 2.02 m in the world, stored in a submap frame."""
    generator = np.random.default_rng(number)
    count = int(12000 * (right_m - left_m))
    places = generator.uniform((left_m, 0.0, 2.02), (right_m, 1.0, 2.021), (count, 3))
    cloud = GaussianCloud.from_values(
        torch.tensor(places, dtype=torch.float32),
        torch.full((count,), 0.02),
        torch.full((count,), 0.9),
        torch.full((count, 3), colour) * torch.tensor(1.0 + 0.2 * places, dtype=torch.float32),
    )
    T = se3.exp(np.array([0.1, 0.2, 0.3, 0.2, 0.1, 0.3]) * number)
    own = cloud.transformed(se3.inverse(T))
    full = torch.full((count,), steps, dtype=torch.int32)
    return Submap(number, T, own, [], full, optimiser=OptimiserState(full))


def fused_of(parts):
    by_number = {part.number: part for part in parts}
    return fuse_submaps(sorted(by_number), by_number.__getitem__)


def test_overlap_is_kept_from_the_submap_with_more_steps():
    parts = [wall(0, 0.0, 2.0, steps=10), wall(7, 1.0, 3.0, steps=50)]
    fused = fused_of(parts)
    x = fused.gaussians.means[:, 0].numpy()
    assert np.allclose(fused.gaussians.means[:, 2], 2.02, atol=0.01)
    assert (fused.submap.numpy()[x > 1.06] == 7).all()
    assert (fused.submap.numpy()[x < 0.94] == 0).all()
    assert abs(len(x) - 36000) < 2400


def test_submaps_do_not_alternate_from_voxel_to_voxel():
    one, other = wall(0, 0.0, 1.0, steps=10), wall(1, 0.0, 1.0, steps=10)
    other.optimiser.steps[:] = 4 + torch.arange(len(other.gaussians)) % 13  # the same on average
    fused = fused_of([one, other])
    x, y = fused.gaussians.means[:, :2].numpy().T
    blocks = np.floor(x / 0.2).astype(int) * 100 + np.floor(y / 0.2).astype(int)
    owners = [set(fused.submap.numpy()[blocks == block]) for block in np.unique(blocks)]
    assert all(len(owner) == 1 for owner in owners)
    assert set().union(*owners) == {0, 1}, "both are optimised most somewhere"


def test_colours_are_converted_to_the_exposure_of_the_first_submap():
    parts = [wall(0, 0.0, 2.0, 10, 0.4), wall(1, 1.0, 3.0, 50, 0.5)]
    fused = fused_of(parts)
    means, colours = fused.gaussians.means.numpy(), fused.gaussians.colours.numpy()
    truth = 0.4 * (1.0 + 0.2 * means)
    assert np.abs(colours - truth).max() < 0.02
    assert fused.exposures[0] == IDENTITY


@pytest.mark.parametrize("several", [False, True])
def test_the_map_has_the_typical_exposure_of_its_keyframes(several):
    """The first keyframe was exposed half as long as the others."""
    one = wall(0, 0.0, 2.0, 10, 0.4)
    later = Exposure(0.5, 0.1)
    keyframes = [cast(Keyframe, SimpleNamespace(exposure=e)) for e in (IDENTITY, later, later)]
    one = replace(one, keyframes=keyframes)
    parts = {0: one, 1: wall(1, 1.0, 3.0, 50, 0.4)}
    read = parts.__getitem__
    fused = fuse_submaps([0, 1], read, free_space=False) if several else single_submap(0, read)
    means, colours = fused.gaussians.means.numpy(), fused.gaussians.colours.numpy()
    truth = later.undo(0.4 * (1.0 + 0.2 * means))
    assert np.abs(colours - truth).max() < 0.03
    assert np.abs(fused.exposures[0].apply(np.array([0.35])) - 0.5).max() < 1e-6


def test_view_uses_only_visible_parts():
    parts = [wall(number, 4.0 * number, 4.0 * number + 2.0, 10) for number in range(5)]
    fused = fused_of(parts)
    camera = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)
    whole = fused.gaussians
    for x in np.linspace(-3.0, 21.0, 9):
        for turn in (0.0, 0.6, -1.2, 3.0):
            T_world_camera = se3.exp(np.array([x, 0.5, 0, 0, turn, 0]))
            T_world_camera[:3, 3] = (x, 0.5, 0.0)
            some = fused.visible_from(camera, T_world_camera)
            T_camera_world = se3.inverse(T_world_camera)
            drawn, complete = (render(c, camera, T_camera_world) for c in (some, whole))
            assert torch.equal(drawn.colour, complete.colour)
            assert torch.equal(drawn.silhouette, complete.silhouette)
    ahead = se3.exp(np.array([1.0, 0.5, 0, 0, 0, 0]))
    assert len(fused.visible_from(camera, ahead)) < len(whole) / 2
    assert len(fused) == len(whole) == len(fused.submap)
