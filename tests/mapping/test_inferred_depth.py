"""Inferred depth in the map: its weight in the loss, seeding; scale and shift of priors (H-17)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap
from painted_box import box_frames

from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.base.native.constants import DEPTH_SUM, SILHOUETTE
from toolkit.slam.mapping import optimisation
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.losses.options import RgbdLossWeights
from toolkit.splatting.losses.photometric import by_observed_depth, rgbd_loss_torch, weigh_depth

SHAPE = (24, 32)
DEPTH_ONLY = RgbdLossWeights(colour=0.0, silhouette=0.0, structure=0.0)


def box(count: int = 1) -> list[Frame]:
    return list(box_frames(np.tile(np.eye(4), (count, 1, 1)), 64, 48))


def images() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    rendered = torch.rand(5, *SHAPE, generator=generator, dtype=torch.float64)
    rendered[SILHOUETTE] = 0.8 + 0.2 * rendered[SILHOUETTE]
    rendered[DEPTH_SUM] = rendered[SILHOUETTE] * (1.0 + rendered[DEPTH_SUM])
    return rendered


def loss(rendered: torch.Tensor, depth: torch.Tensor, weights=DEPTH_ONLY) -> torch.Tensor:
    rgb = torch.full((3, *SHAPE), 0.5, dtype=torch.float64)
    surface = (rendered[DEPTH_SUM] / rendered[SILHOUETTE]).detach()
    return rgbd_loss_torch(rendered, surface, (rgb, depth), weights) * depth.numel()


def gradient(rendered: torch.Tensor, depth: torch.Tensor, weights=DEPTH_ONLY) -> torch.Tensor:
    leaf = rendered.clone().requires_grad_()
    return torch.autograd.grad(loss(leaf, depth, weights), leaf)[0]


def test_the_depth_loss_of_some_pixels_is_weighted_and_no_other_loss():
    rendered = images()
    depth = torch.full(SHAPE, 1.5, dtype=torch.float64)
    mask = torch.zeros(SHAPE, dtype=torch.bool)
    mask[:, 10:] = True
    weights = RgbdLossWeights()
    found = gradient(rendered, depth, weights)
    weigh_depth(found, rendered, mask, 0.3)
    without = gradient(rendered, depth, replace(weights, depth=0.0))
    only = gradient(rendered, depth)
    expected = without + torch.where(mask, 0.3, 1.0) * only
    assert torch.allclose(found, expected, atol=1e-9)


def test_the_derivative_by_the_observed_depth():
    rendered = images()
    depth = torch.full(SHAPE, 1.5, dtype=torch.float64)
    found = by_observed_depth(gradient(rendered, depth), rendered)
    step = torch.zeros(SHAPE, dtype=torch.float64)
    step[5, 7] = 1e-6
    # The reference's scale grows with the observed depth; its change is small and not included.
    numeric = (loss(rendered, depth + step) - loss(rendered, depth - step)) / 2e-6
    assert float(found[5, 7]) == pytest.approx(float(numeric), rel=0.03)


@pytest.mark.parametrize("inferred", [False, True])
def test_inferred_depth_does_not_seed_in_front_of_the_map(inferred):
    frame = box()[0]
    mapper = MappedSubmap(MapperOptions(first_iterations=3, iterations=0))
    mapper.add_keyframe(Keyframe.from_frame(frame, np.eye(4)))
    block = np.zeros(frame.depth_m.shape, bool)
    block[10:30, 10:30] = True
    depth_m = np.where(block, 0.5 * frame.depth_m, frame.depth_m).astype(np.float32)
    nearer = replace(frame, index=1, depth_m=depth_m, inferred=block if inferred else None)
    seeded = mapper.add_keyframe(Keyframe.from_frame(nearer, np.eye(4))).seeded
    assert seeded == 0 if inferred else seeded > 20


def test_inferred_depth_seeds_where_the_map_is_empty():
    frame = box()[0]
    mapper = MappedSubmap(MapperOptions(first_iterations=1))
    half = frame.depth_m.copy()
    half[:, 32:] = 0.0
    mapper.add_keyframe(Keyframe.from_frame(replace(frame, depth_m=half), np.eye(4)))
    mask = np.zeros(half.shape, bool)
    mask[:, 32:] = True
    whole = replace(frame, index=1, inferred=mask)
    assert mapper.add_keyframe(Keyframe.from_frame(whole, np.eye(4))).seeded > 100


def test_a_keyframe_keeps_what_was_inferred():
    frame = box()[0]
    mask = np.zeros(frame.depth_m.shape, bool)
    mask[:, 32:] = True
    keyframe = Keyframe.from_frame(replace(frame, inferred=mask), np.eye(4))
    keyframe.prior_m, keyframe.depth_moments = keyframe.depth_m, np.arange(7.0)
    again = Keyframe.from_state(keyframe.arrays(), keyframe.values())
    assert np.array_equal(again.inferred.numpy(), mask)
    assert np.array_equal(again.depth_moments, np.arange(7.0))
    assert not again.measured_m[:, 32:].any()
    assert again.measured_m[:, :32].all()
    assert np.array_equal(again.as_frame().inferred, mask)


def adjusted(factor: float) -> Keyframe:
    """A second keyframe whose depth is wrong by a factor, after optimisation with the map."""
    frames = box(2)
    mapper = MappedSubmap(MapperOptions(first_iterations=10, iterations=40, fuse_depth=False))
    mapper.add_keyframe(Keyframe.from_frame(frames[0], np.eye(4)))
    wrong = replace(frames[1], index=1, depth_m=(factor * frames[1].depth_m).astype(np.float32))
    keyframe = Keyframe.from_frame(wrong, np.eye(4))
    keyframe.prior_m = keyframe.depth_m
    mapper.add_keyframe(keyframe)
    return keyframe


def median_ratio(keyframe: Keyframe) -> float:
    return float(np.median(keyframe.depth_m.numpy() / box()[0].depth_m))


@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_scale_and_shift_of_a_prior_follow_the_map(factor, monkeypatch):
    monkeypatch.setattr(optimisation, "_REGULARISATION", 0.0)
    keyframe = adjusted(factor)
    assert abs(median_ratio(keyframe) - 1.0) < 0.6 * abs(factor - 1.0)
    assert np.exp(keyframe.depth_moments[0]) > 0


def test_regularisation_keeps_scale_and_shift(monkeypatch):
    found = []
    for weight in (0.0, 100.0):
        monkeypatch.setattr(optimisation, "_REGULARISATION", weight)
        found.append(adjusted(1.02))
    free, held = found
    assert np.abs(held.depth_moments[:2]).max() < 0.2 * np.abs(free.depth_moments[:2]).max()


def test_measured_depth_is_not_adjusted():
    frame = box()[0]
    mapper = MappedSubmap(MapperOptions(first_iterations=3))
    keyframe = Keyframe.from_frame(frame, np.eye(4))
    mapper.add_keyframe(keyframe)
    assert keyframe.depth_moments is None
    assert np.array_equal(keyframe.depth_m.numpy(), frame.depth_m)
