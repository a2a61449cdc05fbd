"""gsplat behind our interface: against the reference, where it and a GPU are."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from splat_scenes import exact, reference_images, scene_at_pixels, skewed_camera

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.rendering.gsplat import GsplatBackend
from toolkit.rendering.reference import ReferenceBackend


def test_it_draws_what_the_reference_draws():
    """Near the axis, where a projected covariance is as round as ours."""
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("gsplat needs a GPU")
    pixels = [(14.0 + i % 4, 19.0 + i // 4) for i in range(16)]
    depths = [1.0 + 0.1 * i for i in range(16)]
    scene = scene_at_pixels(pixels, skewed_camera(33, 33), depths, channels=3)
    cloud = GaussianCloud(*(getattr(scene.cloud, f.name).cuda() for f in fields(GaussianCloud)))
    drawn = GsplatBackend().forward(
        cloud, scene.camera, scene.T_camera_map, cloud.features, None, centres=True
    )
    assert drawn.images.shape == (11, 33, 33)
    expected = reference_images(scene)
    assert float((drawn.images[:8].cpu() - expected).abs().max()) < 0.05
    weights = scene.loss_weights()
    actual = drawn.backward(weights.cuda())
    truth = exact(scene).forward(ReferenceBackend()).backward(weights.double())
    for name in ("colours", "features", "opacity_logits"):
        close = torch.nn.functional.cosine_similarity(
            getattr(actual, name).double().cpu().flatten(), getattr(truth, name).flatten(), dim=0
        )
        assert float(close) > 0.99, name
