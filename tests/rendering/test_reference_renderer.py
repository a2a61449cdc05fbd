"""Reference renderer: comparison with the equations and with finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import (
    dense_images,
    discontinuous_pixels,
    exact,
    random_scene,
    reference_images,
    scene_at_pixels,
    skewed_camera,
)

from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOutput
from toolkit.splatting.rendering.reference import composite


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    channels=st.integers(0, 4),
)
def test_tiles_do_not_change_the_result(seed: int, width: int, height: int, channels: int) -> None:
    scene = random_scene(seed, count=25, channels=channels, size=(width, height))
    continuous = ~discontinuous_pixels(scene)
    difference = reference_images(scene).numpy() - dense_images(scene)
    np.testing.assert_allclose(difference * continuous, 0.0, atol=1e-12)


def test_one_gaussian_against_closed_form() -> None:
    camera = skewed_camera(9, 7)
    scene = scene_at_pixels([(4.0, 3.0)], camera, depth_m=2.0, sigma_px=1.5, opacity=0.8)
    images = reference_images(scene)
    alpha = 0.8 * math.exp(-0.5 * (2**2 + 1**2) / 1.5**2)
    expected = [*(alpha * scene.cloud.colours[0]).tolist(), alpha * 2.0, alpha]
    assert images[:, 4, 6].tolist() == pytest.approx(expected, rel=1e-5)


def test_nearer_gaussian_occludes_the_farther() -> None:
    scene = scene_at_pixels([(4, 3), (4, 3)], skewed_camera(9, 7), [3.0, 1.0], opacity=0.75)
    silhouette, depth = reference_images(scene)[[4, 3], 3, 4]
    assert float(silhouette) == pytest.approx(0.75 + 0.25 * 0.75, rel=1e-6)
    assert float(depth) == pytest.approx(0.75 * 1.0 + 0.25 * 0.75 * 3.0, rel=1e-6)


def test_depth_does_not_depend_on_opacity() -> None:
    scene = scene_at_pixels([(4, 3)], skewed_camera(9, 7), depth_m=2.0, opacity=0.5)
    output = RenderOutput(reference_images(scene))
    assert float(output.depth_sum_m[3, 4]) == pytest.approx(1.0, rel=1e-6)
    assert float(output.depth_m[3, 4]) == pytest.approx(2.0, rel=1e-6)
    nothing = RenderOutput(torch.zeros(5, 2, 2))
    assert torch.equal(nothing.depth_m, torch.zeros(2, 2))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gradients_equal_finite_differences(seed: int) -> None:
    scene = exact(random_scene(seed, count=6, channels=2, size=(17, 5)))
    weights = scene.loss_weights(seed).double()

    def loss(*inputs: torch.Tensor) -> torch.Tensor:
        means, log_radii, opacity_logits, colours, features, T = inputs
        cloud = GaussianCloud(means, log_radii, opacity_logits, colours, features)
        return (weights * composite(cloud, scene.camera, T, features)).sum()

    cloud = scene.cloud
    inputs = (cloud.means, cloud.log_radii, cloud.opacity_logits, cloud.colours, cloud.features)
    T_camera_map = torch.from_numpy(scene.T_camera_map[:3])
    leaves = [x.clone().requires_grad_() for x in (*inputs, T_camera_map)]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-5, rtol=1e-5)
