"""Submaps become one map: a surface that several show is told by one of them."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.refinement.fusion import fuse_submaps
from toolkit.submaps.submap import Submap


def wall(number, left_m, right_m, steps, colour=0.5):
    """A wall at z = 2.02 m in the world, told in a frame of its own."""
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
    told = cloud.transformed(se3.inverse(T))
    full = torch.full((count,), steps, dtype=torch.int32)
    return Submap(number, T, told, [], full, steps=full)


def test_a_wall_seen_by_two_is_told_by_the_surer_one():
    parts = [wall(0, 0.0, 2.0, steps=10), wall(7, 1.0, 3.0, steps=50)]
    fused = fuse_submaps(lambda: parts)
    x = fused.gaussians.means[:, 0].numpy()
    assert np.allclose(fused.gaussians.means[:, 2], 2.02, atol=0.01)
    assert (fused.submap.numpy()[x > 1.06] == 7).all()
    assert (fused.submap.numpy()[x < 0.94] == 0).all()
    assert abs(len(x) - 36000) < 2400


def test_colours_come_to_the_first_ones_exposure():
    parts = [wall(0, 0.0, 2.0, 10, 0.4), wall(1, 1.0, 3.0, 50, 0.5)]
    fused = fuse_submaps(lambda: iter(parts))
    means, colours = fused.gaussians.means.numpy(), fused.gaussians.colours.numpy()
    truth = 0.4 * (1.0 + 0.2 * means)
    assert np.abs(colours - truth).max() < 0.02
    assert fused.exposures[0] == (1.0, 0.0)
