"""Masks from depth, colour and class labels."""

from __future__ import annotations

import numpy as np
import torch
from panels import keyframe, panel_image

from toolkit.scene.instances.geometric import GeometricMasks


def numbers(ids: np.ndarray, *pixels: tuple[int, int]) -> list[int]:
    return [int(ids[pixel]) for pixel in pixels]


def test_touching_surfaces_of_two_classes_are_two_masks():
    view = keyframe(0)
    view.class_ids = torch.from_numpy(panel_image().astype(np.int16))
    masks = GeometricMasks().masks(view)
    assert masks is not None
    assert len(masks) == 2
    left, right = numbers(masks.ids, (60, 20), (60, 140))
    assert left != right
    assert min(left, right) > 0


def test_one_class_at_two_depths_is_two_masks():
    view = keyframe(0)
    view.class_ids = torch.ones((120, 160), dtype=torch.int16)
    view.depth_m[:, 80:] = 3.0
    masks = GeometricMasks().masks(view)
    assert masks is not None
    left, right = numbers(masks.ids, (60, 20), (60, 140))
    assert left != right


def test_a_tilted_plane_is_one_mask():
    view = keyframe(0)
    # z = 2 / (1 + 0.5 y) for a plane that recedes towards the top.
    rows = (torch.arange(120) - 59.5) / 80.0
    view.depth_m = (2.0 / (1.0 + 0.5 * rows))[:, None].expand(120, 160).contiguous()
    masks = GeometricMasks().masks(view)
    assert masks is not None
    assert len(masks) == 1


def test_a_fold_ends_a_surface_without_classes():
    view = keyframe(0)
    rows = (torch.arange(120) - 59.5) / 80.0
    # A wall at z = 2, and a floor at y = 0.4.
    floor_m = torch.where(rows > 0.2, 0.4 / rows.clamp(min=0.2), torch.tensor(2.0))
    view.depth_m = floor_m[:, None].expand(120, 160).contiguous()
    masks = GeometricMasks().masks(view)
    assert masks is not None
    wall, floor = numbers(masks.ids, (20, 80), (100, 80))
    assert wall != floor
    assert min(wall, floor) > 0


def test_an_edge_of_colour_ends_a_surface_without_classes():
    view = keyframe(0)
    view.rgb[:, :, 80:] = 20
    masks = GeometricMasks().masks(view)
    assert masks is not None
    left, right = numbers(masks.ids, (60, 20), (60, 140))
    assert left != right


def test_pixels_without_depth_have_no_mask():
    view = keyframe(0)
    view.depth_m[:60] = 0.0
    masks = GeometricMasks().masks(view)
    assert masks is not None
    assert not masks.ids[:58].any()
    assert masks.ids[62:118, 2:158].all()
