"""View-dependent surfaces: a reflection on a wall is found, texture and exposure are not."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.base.geometry.camera import Camera
from toolkit.slam.tracking.view_dependence import AlignedView, view_dependent, without_gradient
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import model_level

CAMERA = Camera(64.0, 64.0, 39.5, 29.5, 80, 60)
PATH_M = (0.0, 0.25, 0.5, -0.25)
DEPTH_M = 2.0


EDGE_M = -0.2


def wall(x_m: float, gloss: float, gain: float = 1.0, edge_m: float = EDGE_M) -> AlignedView:
    """A textured wall, seen from the side; its left part reflects stripes far behind it."""
    rays = CAMERA.rays()
    on_wall = rays[..., :2] * DEPTH_M + np.array([x_m, 0.0])
    behind = rays[..., 0] * 3.0 * DEPTH_M + x_m
    texture = 0.4 + 0.1 * np.sin(9.0 * on_wall[..., 0]) * np.sin(7.0 * on_wall[..., 1])
    reflected = gloss * np.sin(4.0 * behind) * (on_wall[..., 0] < edge_m)
    noise = np.random.default_rng(int(100 * x_m) + 50).normal(0.0, 0.005, texture.shape)
    intensity = torch.from_numpy((gain * (texture + reflected) + noise).astype(np.float32))
    level = FrameLevel(CAMERA, intensity, torch.full((60, 80), DEPTH_M))
    T_map_camera = np.eye(4)
    T_map_camera[0, 3] = x_m
    return AlignedView(T_map_camera, level)


def masks(gloss: float, gain: float = 1.0) -> list[np.ndarray]:
    new, *others = [wall(x, gloss, gain if x == 0.0 else 1.0) for x in PATH_M]
    found = view_dependent(new, others)
    return [np.zeros((60, 80), bool) if mask is None else mask for mask in found]


def test_a_reflection_is_found_where_it_is() -> None:
    for x_m, mask in zip(PATH_M[1:], masks(gloss=0.1), strict=True):
        on_wall = CAMERA.rays()[..., 0] * DEPTH_M + x_m
        shown = np.abs(on_wall) < 0.9  # by the new view as well
        assert mask[shown & (on_wall < EDGE_M - 0.1)].mean() > 0.6
        assert mask[shown & (on_wall > EDGE_M + 0.1)].mean() < 0.05


def test_a_view_that_contradicts_nearly_everywhere_is_kept_whole() -> None:
    new, *others = [wall(x, gloss=0.1, edge_m=0.9) for x in PATH_M]
    assert view_dependent(new, others) == [None] * len(others)


def test_texture_and_exposure_do_not_depend_on_the_view() -> None:
    assert max(mask.mean() for mask in masks(gloss=0.0)) < 0.01
    assert max(mask.mean() for mask in masks(gloss=0.0, gain=1.1)) < 0.01


def test_the_same_view_again_is_no_evidence() -> None:
    view = wall(0.0, gloss=0.1)
    assert view_dependent(view, [view, view]) == [None, None]


def test_only_the_gradient_within_the_mask_is_removed() -> None:
    level = model_level(wall(0.0, gloss=0.0).frame)
    mask = np.zeros((30, 40), bool)
    mask[:, :20] = True
    changed = without_gradient(level, mask)
    assert not changed.texture[:, :40, 1:3].any()
    assert torch.equal(changed.texture[:, 40:], level.texture[:, 40:])
    assert torch.equal(changed.texture[..., 3], level.texture[..., 3])
