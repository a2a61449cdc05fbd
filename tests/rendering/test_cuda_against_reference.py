"""The Triton kernels against the reference, in value and in gradient: spheres.

test_cuda_ellipsoids.py has the tests of ellipsoids.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cuda_backend import DEVICE, FLOAT32, Cuda, assert_agrees
from splat_scenes import (
    Scene,
    assert_identical,
    assert_same_gradients,
    assert_same_images,
    exact,
    gradients_of,
    largest_value,
    random_scene,
    reference_images,
    scene_at_pixels,
    skewed_camera,
)
from torch import Tensor

from toolkit.base.native.constants import MIN_TRANSMITTANCE
from toolkit.splatting.rendering import backend
from toolkit.splatting.rendering.cuda.tuning import Tuning
from toolkit.splatting.rendering.reference import ReferenceBackend

pytestmark = pytest.mark.usefixtures("poisoned_memory")


def same(a: Tensor, b: Tensor) -> bool:
    """Assert exact equality, or on a GPU, where these are two kernels, equality up to rounding."""
    if DEVICE == "cpu":
        return torch.equal(a, b)
    return float((a - b).abs().max()) <= 1e-4 * max(1.0, float(b.abs().max()))


@pytest.mark.parametrize("channels", [0, 1, 13, 105])
def test_any_number_of_channels(channels: int) -> None:
    assert_agrees(random_scene(channels, count=30, channels=channels, size=(20, 18)))


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (17, 15), (31, 3)])
def test_any_image_size(size: tuple[int, int]) -> None:
    assert_agrees(random_scene(7, count=20, size=size))


@pytest.mark.parametrize(
    "other",
    [
        {"side": 16, "warps": 8, "narrow_warps": 8, "channels_backward": 16},
        {"batch": 32},
        {"narrow_warps": 1, "warps": 2},
    ],
)
@pytest.mark.parametrize("channels", [0, 5])
def test_tuning_parameters_do_not_change_results(other: dict[str, int], channels: int) -> None:
    scene = random_scene(3, count=30, channels=channels, size=(23, 18))
    assert_agrees(scene, replace(FLOAT32, **other))


def test_channels_are_split_when_memory_is_limited() -> None:
    """Processing channels in blocks is bit-identical to processing all at once."""
    scene = random_scene(5, count=20, channels=37, size=(16, 12))
    narrow = replace(FLOAT32, channels_forward=16, channels_backward=16, scratch_bytes=5000)
    assert_agrees(scene, narrow)


def test_splits_are_multiples_of_the_block_size() -> None:
    """One channel beyond a block would cost as much as another block."""
    parts = [Tuning(scratch_bytes=4000 * most).channels_at_once(1000) for most in (0, 5, 35, 101)]
    assert parts == [1, 5, 32, 96]
    assert Tuning().channels_at_once(0) >= 1


@pytest.mark.skipif(DEVICE == "cpu", reason="the interpreter does not round to tf32")
def test_tf32_error_is_bounded() -> None:
    """TF32 has 11 bits: an error of 2^-10 per factor, and twice that after the chain rule."""
    scene = random_scene(13, channels=40)
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, Cuda(Tuning()), weights), expected, 4e-3)
    images = scene.draw(Cuda(Tuning())).double()
    bound = 2**-9 * largest_value(scene)
    assert float((images - reference_images(scene)).abs().max()) <= bound


def test_more_splats_than_a_batch_in_one_tile() -> None:
    """With low opacity, so that all of them contribute."""
    scene = random_scene(11, count=60, channels=2, size=(9, 7))
    faint = scene.with_cloud(opacity_logits=scene.cloud.opacity_logits.clamp(max=-3.0))
    assert_agrees(faint)


def test_early_termination_error_is_bounded() -> None:
    """Tiles with transmittance below 1e-4 are terminated, which bounds the error."""
    count = 40
    scene = scene_at_pixels(
        [(4 + 0.02 * k, 3 - 0.01 * k) for k in range(count)],
        skewed_camera(8, 8),
        [1.0 + 0.05 * k for k in range(count)],
        sigma_px=12.0,
        opacity=0.7,
        channels=3,
    )
    expected = reference_images(scene)
    drawn = scene.forward(Cuda())
    assert float((drawn.images.double() - expected).abs().max()) <= (
        MIN_TRANSMITTANCE * largest_value(scene)
    )
    weights = scene.loss_weights()
    actual = gradients_of(scene, Cuda(), weights)
    # The rows of pairs behind the last batch are set to zero.
    assert not actual["means"][32:].any() and not actual["features"][32:].any()
    exact_gradients = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(actual, exact_gradients, tolerance=10 * 2.3 * MIN_TRANSMITTANCE)


def test_gaussians_of_equal_depth_keep_their_order() -> None:
    """Of Gaussians at equal depth, the first in the map is in front, within and across tiles."""
    pixels = (torch.rand(30, 2, generator=torch.Generator().manual_seed(4)) * 18).tolist()
    scene = scene_at_pixels(pixels, skewed_camera(18, 18), 1.5, sigma_px=2.5, channels=2)
    assert_agrees(scene)


def test_behind_and_at_the_camera() -> None:
    depths = [1.0, -1.0, 0.0, 0.005, 0.02, -0.02]
    scene = scene_at_pixels([(5, 4)] * 6, skewed_camera(12, 10), 1.0, channels=2)
    means = scene.cloud.means.clone()
    means[:, 2] = torch.tensor(depths)
    scene = scene.with_cloud(means=means)
    assert_agrees(scene)
    ids = scene.forward(Cuda()).backward(scene.loss_weights()).ids
    assert ids.tolist() == [0, 4]


@pytest.mark.parametrize("group", ["means", "log_radii", "opacity_logits"])
def test_gaussians_with_nan_geometry_are_ignored(group: str) -> None:
    scene = random_scene(5, count=12, size=(12, 10))
    spoiled = getattr(scene.cloud, group).clone()
    spoiled[5] = torch.nan
    keep = torch.arange(12) != 5
    without = Scene(scene.cloud.select(keep), scene.camera, scene.T_camera_map)
    assert torch.equal(scene.with_cloud(**{group: spoiled}).draw(Cuda()), without.draw(Cuda()))


def test_opacity_one_and_radii_of_all_sizes() -> None:
    scene = scene_at_pixels(
        [(5, 4), (6, 5), (4, 5), (7.5, 7.5)], skewed_camera(16, 12), [1.0, 2.0, 1.5, 3.0]
    )
    logits = torch.tensor([torch.inf, 0.3, -torch.inf, 1.0])
    radii = scene.cloud.log_radii.clone()
    radii[3] = 4.0
    scene = scene.with_cloud(opacity_logits=logits, log_radii=radii)
    assert_agrees(scene)
    radii = radii.clone()
    radii[0], radii[3] = -60.0, 60.0
    gradients = gradients_of(scene.with_cloud(log_radii=radii), Cuda(), torch.ones(5, 12, 16))
    assert all(torch.isfinite(g).all() for g in gradients.values())


@pytest.mark.parametrize("count", [0, 2])
def test_nothing_in_view(count: int) -> None:
    camera = skewed_camera(20, 17)
    cloud = scene_at_pixels([(-500, 4), (5, 900)][:count], camera, channels=4).cloud
    drawn = Cuda().forward(cloud, camera, np.eye(4), cloud.features, None)
    assert torch.equal(drawn.images, torch.zeros(9, 17, 20))
    gradients = drawn.backward(torch.ones(9, 17, 20))
    assert gradients.ids.numel() == 0
    assert gradients.features.shape == (0, 4)
    assert torch.equal(gradients.T_camera_map, torch.zeros(3, 4, dtype=torch.float64))


def test_region_renders_only_its_tiles() -> None:
    """Regions are masks of 16x16 pixels, independent of the kernels' tile size."""
    scene = random_scene(8, count=40, channels=2, size=(40, 20))
    region = torch.tensor([[True, False, True], [False, True, False]])
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights, region)
    assert_same_images(scene.draw(Cuda(), region), scene, reference_images(scene, region))
    assert_same_gradients(gradients_of(scene, Cuda(), weights, region), expected)


def test_centres_are_last_and_do_not_change_others() -> None:
    scene = random_scene(40, count=20, channels=3, size=(18, 14))
    arguments = (scene.cloud, scene.camera, scene.T_camera_map)
    plain = Cuda().forward(*arguments, scene.cloud.features, None)
    drawn = Cuda().forward(*arguments, scene.cloud.features, None, centres=True)
    assert same(drawn.images[:-3], plain.images)
    means = ReferenceBackend().forward(*arguments, scene.cloud.means, None).images[5:]
    assert torch.allclose(drawn.images[-3:], means, atol=1e-5)


def test_detached_features_do_not_affect_geometry() -> None:
    scene = random_scene(64, count=20, channels=4, size=(18, 14))
    weights = scene.loss_weights()
    drawn = scene.forward(Cuda())
    whole, base = drawn.backward(weights), drawn.backward(weights[:5])
    detached = drawn.backward(weights, detached=True)
    assert base.features.shape == (len(base.ids), 0)
    for name in ("means", "log_radii", "opacity_logits", "colours", "T_camera_map"):
        assert same(getattr(detached, name), getattr(base, name)), name
    assert same(detached.features, whole.features)
    assert drawn.backward(weights, colours=False).colours is None


def test_results_are_reproducible() -> None:
    scene = random_scene(21, count=40, channels=3, size=(24, 18))
    weights = scene.loss_weights()
    once, again = (gradients_of(scene, Cuda(), weights) for _ in range(2))
    assert_identical(again, once)
    ids = scene.forward(Cuda()).backward(weights).ids
    assert bool((ids.diff() > 0).all())


def test_image_gradients_of_wrong_shape_raise() -> None:
    drawn = random_scene(0, count=3, channels=2, size=(9, 8)).forward(Cuda())
    with pytest.raises(ValueError, match=r"image gradients must have shape \[7, 8, 9\]"):
        drawn.backward(torch.zeros(6, 8, 9))


def test_backend_is_selected_by_name() -> None:
    assert backend("cuda").name == "cuda"
