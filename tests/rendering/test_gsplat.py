"""gsplat backend: arguments of the call, and comparison with the reference on a GPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from splat_scenes import (
    assert_same_gradients,
    ellipsoid_scene,
    exact,
    gradients_of,
    random_scene,
    reference_images,
    scene_at_pixels,
    skewed_camera,
)
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, PARAMETERS, GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering.gsplat import GsplatBackend
from toolkit.splatting.rendering.reference import ReferenceBackend, composite


class Rasteriser:
    """Fake of gsplat.rasterization that renders with the reference on the CPU."""

    @staticmethod
    def rasterization(
        means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, **rest: Any
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        assert rest["render_mode"] == "RGB+D" and len(means) > 0
        K, T = rest["Ks"][0], rest["viewmats"][0]
        # gsplat's pixel centres are at half-integers.
        cx, cy = (float(c) - 0.5 for c in K[:2, 2])
        camera = Camera(float(K[0, 0]), float(K[1, 1]), cx, cy, rest["width"], rest["height"])
        rgb, features = colors[:, :3], colors[:, 3:]
        cloud = GaussianCloud.from_values(means, scales[:, 0], opacities, rgb, features)
        low_pass = LowPass(rest["eps2d"], rest["rasterize_mode"] == "antialiased")
        cloud = replace(cloud, low_pass=low_pass)
        if float((scales.amax(dim=1) - scales.amin(dim=1)).max()) > 0:
            shapes = Ellipsoids(scales.log(), quats, scales.new_zeros(len(means), 0, 3))
            cloud = replace(cloud, ellipsoids=shapes)
        images = composite(cloud, camera, T, features)
        drawn = torch.cat([images[:3], images[5:], images[3:4]])
        return drawn.permute(1, 2, 0)[None], images[4][None, ..., None], {}


def test_arguments_are_converted_to_conventions_of_gsplat() -> None:
    scene = random_scene(3, count=20, channels=4, size=(21, 17))
    ours = GsplatBackend(Rasteriser(), device="cpu")
    images = scene.draw(ours)
    assert torch.allclose(images, reference_images(scene).float(), atol=1e-4)
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, ours, weights), expected, tolerance=1e-3)


@pytest.mark.parametrize("low_pass", [LOW_PASS_3DGS, LowPass(0.1, compensated=True)])
def test_ellipsoids_are_passed_with_the_colours_of_the_view(low_pass: LowPass) -> None:
    scene = ellipsoid_scene(5, low_pass, count=20, channels=1, size=(21, 17))
    images = scene.draw(GsplatBackend(Rasteriser(), device="cpu"))
    assert torch.allclose(images, reference_images(scene).float(), atol=1e-4)


def test_regions_and_centres_are_supported() -> None:
    scene = random_scene(8, count=40, channels=2, size=(40, 20))
    region = torch.tensor([[True, False, True], [False, True, False]])
    arguments = (scene.cloud, scene.camera, scene.T_camera_map, scene.cloud.features, region)
    ours = GsplatBackend(Rasteriser(), device="cpu").forward(*arguments, centres=True)
    truth = ReferenceBackend().forward(*arguments, centres=True)
    assert torch.allclose(ours.images, truth.images, atol=1e-4)


def test_empty_map_does_not_call_gsplat() -> None:
    camera = skewed_camera(20, 17)
    empty = GaussianCloud.empty(3)
    drawn = GsplatBackend(Rasteriser(), device="cpu").forward(
        empty, camera, np.eye(4), empty.features, None, centres=True
    )
    assert torch.equal(drawn.images, torch.zeros(11, 17, 20))
    assert len(drawn.backward(torch.ones(8, 17, 20)).ids) == 0


@pytest.mark.parametrize("device", ["cuda", "cpu"])
def test_gsplat_agrees_with_the_reference(device: str) -> None:
    """Near the optical axis, where projected covariances are circular."""
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("gsplat needs a GPU")
    pixels = [(14.0 + i % 4, 19.0 + i // 4) for i in range(16)]
    depths = [1.0 + 0.1 * i for i in range(16)]
    scene = scene_at_pixels(pixels, skewed_camera(33, 33), depths, channels=3)
    cloud = GaussianCloud(*(getattr(scene.cloud, f).to(device) for f in PARAMETERS))
    drawn = GsplatBackend().forward(
        cloud, scene.camera, scene.T_camera_map, cloud.features, None, centres=True
    )
    assert drawn.images.shape == (11, 33, 33) and drawn.images.device.type == device
    expected = reference_images(scene)
    assert float((drawn.images[:8].cpu() - expected).abs().max()) < 0.05
    weights = scene.loss_weights()
    actual = drawn.backward(weights.to(device))
    truth = exact(scene).forward(ReferenceBackend()).backward(weights.double())
    for name in ("colours", "features", "opacity_logits"):
        close = torch.nn.functional.cosine_similarity(
            getattr(actual, name).double().cpu().flatten(), getattr(truth, name).flatten(), dim=0
        )
        assert float(close) > 0.99, name
