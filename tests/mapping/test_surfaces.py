"""Centres slide on their surfaces, and leave them only together."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.slam.mapping.surfaces import Surfaces
from toolkit.splatting.gaussians.cloud import GaussianCloud

RADIUS_M = 0.05


def spheres(centres: torch.Tensor) -> GaussianCloud:
    ones = torch.ones(len(centres))
    return GaussianCloud.from_values(centres, RADIUS_M * ones, 0.9 * ones, torch.ones_like(centres))


def plane(normal_to: int) -> torch.Tensor:
    """[100, 3] points of a plane, evenly strewn."""
    steps = torch.linspace(0, 1, 10)
    flat = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2)
    points = torch.zeros(100, 3)
    points[:, [axis for axis in range(3) if axis != normal_to]] = flat
    return points


def test_a_centre_that_left_alone_is_put_back_near_where_it_slid_to():
    for axis in range(3):
        centres = plane(axis)
        surfaces = Surfaces.of(spheres(centres))
        moved = centres.clone()
        moved[44] += torch.tensor([0.03, -0.04, 0.035])
        back = surfaces.keep(moved)
        along = [other for other in range(3) if other != axis]
        # Its own distance is one of the sixteen in the mean.
        mean_m = float(moved[44, axis].abs()) / 16
        assert abs(float(back[44, axis].abs()) - mean_m) <= 0.051 * RADIUS_M
        assert torch.allclose(back[44, along], moved[44, along], atol=1e-6)


def test_noise_across_a_surface_is_removed_and_noise_along_it_stays():
    centres = plane(2)
    surfaces = Surfaces.of(spheres(centres))
    noise = np.random.default_rng(0).normal(0, 0.05, (100, 3))
    moved = centres + torch.from_numpy(noise).float()
    for _ in range(20):
        moved = surfaces.keep(moved)
    assert float(surfaces.off_m(moved).abs().max()) < 0.1 * RADIUS_M
    assert float(moved[:, 2].std()) < 0.4 * 0.05
    assert torch.allclose(moved[:, :2], centres[:, :2] + torch.from_numpy(noise[:, :2]).float())


def test_a_surface_moves_as_a_whole_whatever_the_signs_of_its_normals():
    centres = plane(2)
    surfaces = Surfaces.of(spheres(centres))
    centres += torch.tensor([0.0, 0.0, 0.2])
    assert torch.allclose(surfaces.keep(centres), centres, atol=1e-6)


def test_two_sides_of_an_edge_move_apart():
    floor, wall = plane(2), plane(0)
    centres = torch.cat([floor + torch.tensor([0.05, 0.0, 0.0]), wall])
    surfaces = Surfaces.of(spheres(centres))
    moved = centres.clone()
    moved[:100, 2] += 0.2
    # Far from the edge, at which normals are those of neither side.
    far = (centres[:, 0] > 0.4) | (centres[:, 2] > 0.4)
    assert torch.allclose(surfaces.keep(moved)[far], moved[far], atol=1e-6)


def test_a_handful_of_centres_has_no_surface():
    centres = torch.eye(3)
    moved = centres + 0.3
    assert torch.equal(Surfaces.of(spheres(centres)).keep(moved), moved)
    none = torch.zeros(0, 3)
    assert torch.equal(Surfaces.of(spheres(none)).keep(none), none)
