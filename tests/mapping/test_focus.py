"""Effort goes to the tiles with the most error left."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from toolkit.mapping.focus import TileFocus
from toolkit.rendering import pixels_of_region, region_of_pixels

KEYFRAME = SimpleNamespace(index=3)


def test_the_first_step_and_every_fourth_see_everything():
    focus = TileFocus(0.25)
    seen = []
    for _ in range(9):
        region = focus.region(KEYFRAME)
        seen.append(region is None)
        if region is None:
            focus.learn(KEYFRAME, torch.rand(5, 40, 60))
    assert seen == [True, False, False, False] * 2 + [True]


def test_the_worst_tiles_are_kept():
    pull = torch.zeros(5, 40, 60)
    pull[1, 20, 3] = 9.0  # tile (1, 0)
    pull[2, 39, 59] = -8.0  # tile (2, 3), not a whole one
    pull[0, 0, 20] = 1e-3  # tile (0, 1)
    focus = TileFocus(2 / 12)
    focus.region(KEYFRAME)
    focus.learn(KEYFRAME, pull)
    region = focus.region(KEYFRAME)
    assert region.nonzero().tolist() == [[1, 0], [2, 3]]


def test_a_share_of_one_never_leaves_tiles_out():
    focus = TileFocus(1.0)
    for _ in range(3):
        assert focus.region(KEYFRAME) is None
        focus.learn(KEYFRAME, torch.rand(5, 8, 8))


def test_regions_and_pixels_go_both_ways():
    region = torch.rand(3, 4, generator=torch.Generator().manual_seed(0)) < 0.5
    pixels = pixels_of_region(region, 40, 60)
    assert pixels.shape == (40, 60)
    assert torch.equal(region_of_pixels(pixels), region)
