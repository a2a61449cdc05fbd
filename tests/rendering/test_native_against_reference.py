"""Native kernels against the reference, in value and in gradient.

Equal to single precision outside the discontinuity band (see splat_scenes), bounded in it.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splat_scenes import (
    Scene,
    assert_same_gradients,
    assert_same_images,
    exact,
    gradients_of,
    largest_value,
    random_scene,
    raw_alphas,
    reference_images,
    scene_at_pixels,
    skewed_camera,
)

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import render
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend


def assert_agrees(
    native: NativeRenderer, scene: Scene, seed: int = 0, tolerance: float = 2e-4
) -> None:
    """Assert that images and gradients of a random loss equal the float64 reference."""
    assert_same_images(scene.draw(native), scene, reference_images(scene))
    weights = scene.loss_weights(seed)
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, native, weights), expected, tolerance)


# Derandomised, so that the test cannot fail randomly because of rounding.
@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.integers(0, 2**32 - 1),
    width=st.integers(1, 70),
    height=st.integers(1, 40),
    count=st.integers(1, 60),
    channels=st.integers(0, 20),
)
def test_random_scenes(
    native: NativeRenderer, seed: int, width: int, height: int, count: int, channels: int
) -> None:
    assert_agrees(native, random_scene(seed, count, channels, (width, height)), seed)


@pytest.mark.parametrize("channels", [0, 1, 3, 6, 12, 17, 28, 29, 100])
def test_any_number_of_channels(native: NativeRenderer, channels: int) -> None:
    assert_agrees(native, random_scene(channels, channels=channels))


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (15, 17), (16, 16), (31, 3)])
def test_any_image_size(native: NativeRenderer, size: tuple[int, int]) -> None:
    assert_agrees(native, random_scene(7, count=30, size=size))


def test_many_splats_in_one_tile(native: NativeRenderer) -> None:
    """More than one batch of the kernels, with low opacity so that all of them contribute."""
    scene = random_scene(11, count=700, channels=5, size=(20, 12))
    faint = scene.with_cloud(opacity_logits=scene.cloud.opacity_logits.clamp(max=-3.5))
    assert_agrees(native, faint)


def test_behind_and_at_the_camera(native: NativeRenderer) -> None:
    """Gaussians in front of the near plane are not rendered and have no gradient."""
    depths = [1.0, -1.0, 0.0, 0.005, 0.02, -0.02]
    scene = scene_at_pixels([(5, 4)] * 6, skewed_camera(12, 10), 1.0, channels=2)
    means = scene.cloud.means.clone()
    means[:, 2] = torch.tensor(depths)
    scene = scene.with_cloud(means=means)
    assert_agrees(native, scene)
    gradients = gradients_of(scene, native, scene.loss_weights())
    for name in ("means", "log_radii", "opacity_logits", "colours", "features"):
        assert not gradients[name][[1, 2, 3, 5]].any(), name
        assert gradients[name][0].any(), name


def test_on_the_image_border(native: NativeRenderer) -> None:
    camera = skewed_camera(21, 18)
    corners = [(0, 0), (20, 0), (0, 17), (20, 17), (-2, 5), (22.5, 9), (7, -1.5), (10, 19)]
    borders = [(15.5, 4.0), (16.0, 15.5), (4.0, 16.0), (15.0, 15.0)]
    assert_agrees(native, scene_at_pixels(corners + borders, camera, channels=2))


def test_radius_below_a_pixel(native: NativeRenderer) -> None:
    """It covers one pixel at a pixel's centre and none between centres."""
    on, between = (5.0, 4.0), (8.5, 6.5)
    scene = scene_at_pixels([on, between], skewed_camera(12, 10), sigma_px=0.05)
    silhouette = scene.draw(native)[4]
    assert float(silhouette[4, 5]) == pytest.approx(0.6, rel=1e-3)
    assert int((silhouette > 0).sum()) == 1
    gradients = gradients_of(scene, native, torch.ones(5, 10, 12))
    assert all(torch.isfinite(g).all() for g in gradients.values())
    assert not gradients["means"][1].any()
    slightly_larger = scene_at_pixels([(5.1, 4.1), (8.4, 6.6)], skewed_camera(12, 10), sigma_px=0.2)
    assert_agrees(native, slightly_larger)


@pytest.mark.parametrize(
    "sigma_px",
    [
        1e-6,
        1e-20,  # sigma squared underflows to 0
    ],
)
def test_vanishing_radius_has_finite_gradients(native: NativeRenderer, sigma_px: float) -> None:
    scene = scene_at_pixels([(5, 4), (7, 6)], Camera(8, 8, 0, 0, 12, 10), sigma_px=2.0)
    log_radii = scene.cloud.log_radii.clone()
    log_radii[0] = float(torch.tensor(sigma_px / 8.0).log())
    gradients = gradients_of(scene.with_cloud(log_radii=log_radii), native, torch.ones(5, 10, 12))
    assert all(torch.isfinite(g).all() for g in gradients.values())
    assert gradients["means"][1].any()


def test_gaussian_that_covers_the_image(native: NativeRenderer) -> None:
    scene = scene_at_pixels(
        [(5, 4), (20, 30), (40, 2)], skewed_camera(50, 35), [1.0, 2.0, 3.0], channels=3
    )
    log_radii = scene.cloud.log_radii.clone()
    log_radii[0] = 3.0
    assert_agrees(native, scene.with_cloud(log_radii=log_radii))
    log_radii[0] = 60.0
    assert float(scene.with_cloud(log_radii=log_radii).draw(native)[4].min()) >= 0.6 - 1e-5


def test_opacity_zero_and_one(native: NativeRenderer) -> None:
    scene = scene_at_pixels(
        [(5, 4), (6, 5), (4, 5)], skewed_camera(12, 10), [1.0, 2.0, 1.5], channels=2
    )
    logits = torch.tensor([torch.inf, 0.3, -torch.inf])
    scene = scene.with_cloud(opacity_logits=logits)
    assert_agrees(native, scene)
    gradients = gradients_of(scene, native, scene.loss_weights())
    assert all(torch.isfinite(g).all() for g in gradients.values())
    assert not gradients["opacity_logits"][[0, 2]].any()


def test_clamped_alpha_has_zero_gradient(native: NativeRenderer) -> None:
    """Over several pixels alpha exceeds 0.999 and is clamped."""
    scene = scene_at_pixels(
        [(3.3, 2.4), (1.2, 3.1)], skewed_camera(8, 6), [1.0, 2.0], 60.0, 0.9999, channels=2
    )
    assert int((raw_alphas(scene)[0][0] > MAX_ALPHA).sum()) > 8
    # At alpha 0.999, computing T - alpha T has a relative error of 2^-24 / 0.001 = 6e-5.
    assert_agrees(native, scene, tolerance=5e-4)


def test_gaussians_of_equal_depth_keep_their_order(native: NativeRenderer) -> None:
    """Of Gaussians at equal depth, the first in the map is in front, within and across tiles."""
    rng = torch.Generator().manual_seed(4)
    pixels = (torch.rand(80, 2, generator=rng) * torch.tensor([40.0, 30.0])).tolist()
    scene = scene_at_pixels(pixels, skewed_camera(40, 30), 1.5, sigma_px=2.5, channels=2)
    assert torch.unique(scene.cloud.means[:, 2]).numel() == 1
    assert_agrees(native, scene)
    swapped = scene.with_cloud(colours=scene.cloud.colours.flip(0))
    assert not torch.allclose(swapped.draw(native), scene.draw(native), atol=1e-2)


def test_empty_map(native: NativeRenderer) -> None:
    scene = Scene(GaussianCloud.empty(4), skewed_camera(20, 17), torch.eye(4).double().numpy())
    drawn = scene.forward(native)
    assert torch.equal(drawn.images, torch.zeros(9, 17, 20))
    gradients = drawn.backward(torch.ones(9, 17, 20))
    assert gradients.ids.numel() == 0
    assert gradients.features.shape == (0, 4)
    assert torch.equal(gradients.T_camera_map, torch.zeros(3, 4, dtype=torch.float64))


def test_nothing_in_view(native: NativeRenderer) -> None:
    scene = scene_at_pixels([(-500, 4), (5, 900)], skewed_camera(12, 10))
    assert not scene.draw(native).any()
    assert not gradients_of(scene, native, torch.ones(5, 10, 12))["T_camera_map"].any()


@pytest.mark.parametrize("group", ["means", "log_radii", "opacity_logits"])
def test_gaussians_with_nan_geometry_are_ignored(native: NativeRenderer, group: str) -> None:
    scene = random_scene(5)
    spoiled = getattr(scene.cloud, group).clone()
    spoiled[10] = torch.nan
    keep = torch.arange(60) != 10
    without = Scene(scene.cloud.select(keep), scene.camera, scene.T_camera_map)
    scene = scene.with_cloud(**{group: spoiled})
    assert torch.equal(scene.draw(native), without.draw(native))
    weights = without.loss_weights()
    actual = gradients_of(scene, native, weights)
    expected = gradients_of(without, native, weights)
    for name, gradient in expected.items():
        kept = actual[name] if name == "T_camera_map" else actual[name][keep]
        assert torch.equal(kept, gradient), name


@pytest.mark.parametrize("group", ["colours", "features"])
def test_nan_value_affects_only_its_support(native: NativeRenderer, group: str) -> None:
    """A NaN colour is rendered, but only in blocks within the Gaussian's support."""
    scene = scene_at_pixels([(6, 6), (25, 20)], skewed_camera(34, 30), channels=2)
    spoiled = getattr(scene.cloud, group).clone()
    spoiled[0] = torch.nan
    images = scene.with_cloud(**{group: spoiled}).draw(native)
    assert torch.isfinite(images[:, 15:, 15:]).all()
    assert torch.equal(images[:, 15:, 15:], scene.draw(native)[:, 15:, 15:])


def test_early_termination_error_is_bounded(native: NativeRenderer) -> None:
    """Blocks with transmittance below 1e-4 are terminated, which bounds the error."""
    count = 60
    scene = scene_at_pixels(
        [(8 + 0.05 * k, 7 - 0.03 * k) for k in range(count)],
        skewed_camera(20, 18),
        [1.0 + 0.05 * k for k in range(count)],
        sigma_px=12.0,
        opacity=0.7,
        channels=3,
    )
    expected = reference_images(scene)
    assert float(1.0 - expected[4].max()) < MIN_TRANSMITTANCE**2  # the stack reaches the threshold
    difference = (scene.draw(native).double() - expected).abs()
    assert 1e-6 < float(difference.max()) <= MIN_TRANSMITTANCE * largest_value(scene)
    weights = scene.loss_weights()
    actual = gradients_of(scene, native, weights)
    expected_gradients = gradients_of(exact(scene), ReferenceBackend(), weights)
    # Each of about ten splats in front lacks alpha / (1 - alpha) = 2.3 times what was
    # omitted behind it, at most 1e-4 of the largest value; the pose gradient is their sum.
    assert_same_gradients(actual, expected_gradients, tolerance=10 * 2.3 * MIN_TRANSMITTANCE)


def test_discontinuity_band_is_bounded(native: NativeRenderer) -> None:
    """A Gaussian at MIN_ALPHA changes a pixel by at most 1/255 of its value."""
    scene = scene_at_pixels([(5.0, 4.0)], Camera(8, 8, 5, 4, 12, 10), opacity=0.5)
    for step in range(-3, 4):
        opacity = torch.full((1,), MIN_ALPHA * (1.0 + step * 1e-7), dtype=torch.float64)
        at_cut = scene.with_cloud(opacity_logits=opacity.logit().float())
        difference = at_cut.draw(native).double() - reference_images(at_cut)
        assert float(difference.abs().max()) <= 1.001 * MIN_ALPHA


def test_colour_gradients_can_be_skipped(native: NativeRenderer) -> None:
    scene = random_scene(2, channels=6)
    weights = scene.loss_weights()
    drawn = scene.forward(native)
    everything = drawn.backward(weights)
    lean = drawn.backward(weights, colours=False)
    assert lean.colours is None
    for name in ("ids", "means", "log_radii", "opacity_logits", "features", "T_camera_map"):
        assert torch.equal(getattr(lean, name), getattr(everything, name)), name


def test_ids_are_ascending_and_contain_all_visible_gaussians(native: NativeRenderer) -> None:
    scene = random_scene(9, count=50)
    ids = scene.forward(native).backward(scene.loss_weights()).ids
    assert bool((ids.diff() > 0).all())
    expected = gradients_of(exact(scene), ReferenceBackend(), scene.loss_weights())
    seen = expected["colours"].abs().sum(dim=1).nonzero().squeeze(1)
    assert set(seen.tolist()) <= set(ids.tolist())


def test_gradients_are_propagated_by_autograd() -> None:
    """Through render() with the default backend."""
    scene = random_scene(6, channels=4)
    weights = scene.loss_weights()
    results = []
    for name, source in (("auto", scene), ("reference", exact(scene))):
        cloud = source.cloud.detached()
        leaves = [
            getattr(cloud, group).requires_grad_()
            for group in ("means", "log_radii", "opacity_logits", "colours", "features")
        ]
        T = torch.from_numpy(source.T_camera_map).requires_grad_()
        output = render(cloud, source.camera, T, features=cloud.features, backend_name=name)
        (output.images * weights).sum().backward()
        assert T.grad is not None
        assert not T.grad[3].any()
        results.append([leaf.grad for leaf in leaves] + [T.grad])
    for actual, expected in zip(*results, strict=True):
        scale = float(expected.abs().max())
        assert float((actual.double() - expected).abs().max()) <= 2e-4 * scale


@pytest.mark.parametrize("channels", [0, 1, 17])
def test_centres_are_last_and_do_not_change_others(native: NativeRenderer, channels: int) -> None:
    scene = random_scene(channels + 40, count=50, channels=channels)
    arguments = (scene.cloud, scene.camera, scene.T_camera_map)
    plain = native.forward(*arguments, scene.cloud.features, None)
    drawn = native.forward(*arguments, scene.cloud.features, None, centres=True)
    assert torch.equal(drawn.images[:-3], plain.images)
    means = native.forward(*arguments, scene.cloud.means, None)
    assert torch.equal(drawn.images[-3:], means.images[5:])
    weights = scene.loss_weights()
    expected, actual = plain.backward(weights), drawn.backward(weights)
    assert torch.equal(actual.means, expected.means)
    assert torch.equal(actual.features, expected.features)


@pytest.mark.parametrize("channels", [1, 4, 26, 101])
def test_detached_features_do_not_affect_geometry(native: NativeRenderer, channels: int) -> None:
    """Gradients of geometry and pose are those without features, others those with features."""
    scene = random_scene(channels + 60, count=50, channels=channels)
    weights = scene.loss_weights()
    drawn = [scene.forward(native) for _ in range(3)]
    whole = drawn[0].backward(weights)
    base = drawn[1].backward(weights[:5])
    detached = drawn[2].backward(weights, detached=True)
    for name in ("means", "log_radii", "opacity_logits", "colours", "T_camera_map"):
        assert torch.allclose(getattr(detached, name), getattr(base, name), rtol=1e-5, atol=1e-6)
    assert torch.allclose(detached.features, whole.features, rtol=1e-5, atol=1e-6)
    expected = exact(scene).forward(ReferenceBackend()).backward(weights.double(), detached=True)
    assert torch.allclose(detached.means.double(), expected.means[detached.ids], atol=1e-3)
