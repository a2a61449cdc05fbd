"""Centres slide on their surfaces."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.mapping.final_optimisation import Surfaces


def grid(normal_to: int) -> torch.Tensor:
    """[100, 3] points of a plane, evenly strewn."""
    steps = torch.linspace(0, 1, 10)
    flat = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2)
    points = torch.zeros(100, 3)
    points[:, [axis for axis in range(3) if axis != normal_to]] = flat
    return points


def test_what_left_a_plane_is_put_back_where_it_slid_to():
    generator = np.random.default_rng(0)
    for axis in range(3):
        centres = grid(axis)
        surfaces = Surfaces.of(centres)
        moved = centres + torch.from_numpy(generator.normal(0, 0.05, (100, 3))).float()
        back = surfaces.project(moved)
        along = [other for other in range(3) if other != axis]
        assert torch.allclose(back[:, axis], torch.zeros(100), atol=1e-6)
        assert torch.allclose(back[:, along], moved[:, along], atol=1e-6)


def test_what_moves_later_leaves_the_surfaces_as_they_were():
    centres = grid(2)
    surfaces = Surfaces.of(centres)
    centres += 1.0
    assert torch.allclose(surfaces.project(centres)[:, 2], torch.zeros(100), atol=1e-6)


def test_a_handful_of_centres_has_no_surface():
    centres = torch.eye(3)
    moved = centres + 0.3
    assert torch.equal(Surfaces.of(centres).project(moved), moved)
    none = torch.zeros(0, 3)
    assert torch.equal(Surfaces.of(none).project(none), none)
