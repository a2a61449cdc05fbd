"""The Triton kernels against the reference, in value and in gradient: ellipsoids and low-pass."""

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
    dense_gradients,
    ellipsoid_scene,
    exact,
    gradients_of,
    largest_value,
    random_scene,
    reference_images,
    scene_at_pixels,
    skewed_camera,
)

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import MIN_TRANSMITTANCE
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, NO_LOW_PASS, PIXEL_FILTER, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering import render
from toolkit.splatting.rendering.cuda import ellipsoids
from toolkit.splatting.rendering.cuda.tuning import Tuning
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend

pytestmark = pytest.mark.usefixtures("poisoned_memory")
FILTERS = [NO_LOW_PASS, LOW_PASS_3DGS, PIXEL_FILTER]
TOLERANCE = 5e-5


def small_scene(seed: int, low_pass: LowPass = PIXEL_FILTER, degree: int = 2) -> Scene:
    return ellipsoid_scene(seed, low_pass, degree, count=20, channels=2, size=(18, 14))


def shaped(scales: list[list[float]], rotations: list[list[float]], degree: int = 0) -> Ellipsoids:
    """Ellipsoids of scales [N, 3] in metres, whose colours do not depend on the view."""
    spheres = Ellipsoids.spheres(torch.zeros(len(scales)), degree)
    return replace(
        spheres, log_scales=torch.tensor(scales).log(), rotations=torch.tensor(rotations)
    )


@pytest.mark.parametrize("low_pass", FILTERS)
@pytest.mark.parametrize("degree", range(4))
def test_harmonics_of_any_degree_and_filters(low_pass: LowPass, degree: int) -> None:
    assert_agrees(small_scene(10 + degree, low_pass, degree), tolerance=TOLERANCE)


@pytest.mark.parametrize("channels", [0, 1, 17])
@pytest.mark.parametrize("size", [(1, 20), (17, 9)])
def test_any_number_of_channels_and_size(channels: int, size: tuple[int, int]) -> None:
    scene = ellipsoid_scene(channels, LOW_PASS_3DGS, 1, count=20, channels=channels, size=size)
    assert_agrees(scene, tolerance=TOLERANCE)


@pytest.mark.parametrize("low_pass", FILTERS[1:])
def test_filtered_spheres(low_pass: LowPass) -> None:
    scene = random_scene(3, count=20, size=(18, 14)).with_cloud(low_pass=low_pass)
    assert_agrees(scene, tolerance=TOLERANCE)


@pytest.mark.parametrize("low_pass", FILTERS)
def test_needles_and_discs(low_pass: LowPass) -> None:
    """Needles across tiles at all angles and discs of any inclination, one of them on edge."""
    angles = torch.linspace(0.0, np.pi, 7)[:6]
    rotations = torch.zeros(12, 4)
    rotations[:6, 0], rotations[:6, 3] = (angles / 2).cos(), (angles / 2).sin()
    rotations[6:, 0], rotations[6:, 2] = (angles / 2).cos(), (angles / 2).sin()
    scales = [[0.1, 0.004, 0.004]] * 6 + [[0.06, 0.03, 0.0002]] * 6
    camera = Camera(100.0, 90.0, 11.0, 9.0, 25, 20)
    pixels = [(4.0 + 1.5 * k, 3.0 + 1.2 * k) for k in range(12)]
    scene = scene_at_pixels(pixels, camera, [1.0 + 0.07 * k for k in range(12)], channels=1)
    shapes = shaped(scales, rotations.tolist())
    assert_agrees(scene.with_cloud(ellipsoids=shapes, low_pass=low_pass), tolerance=TOLERANCE)


@pytest.mark.parametrize("ratio", [50.0, 500.0])
def test_gradients_of_needles_keep_single_precision(ratio: float) -> None:
    """Each axis by itself; a chain rule in float32 loses the gradient of the long one."""
    camera = Camera(100.0, 100.0, 10.0, 8.0, 24, 18)
    scene = scene_at_pixels([(11.3, 8.6)], camera, opacity=0.8)
    shapes = shaped([[0.006 * ratio, 0.006, 0.006]], [[0.9, 0.1, 0.2, 0.35]])
    scene = scene.with_cloud(ellipsoids=shapes)
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    actual = gradients_of(scene, Cuda(), weights)
    for name in ("log_scales", "rotations"):
        np.testing.assert_allclose(actual[name].numpy(), expected[name].numpy(), rtol=1e-4)


def test_outside_of_the_view() -> None:
    """Behind the camera and beside the image; near it, the Jacobian is limited."""
    camera = skewed_camera(12, 10)
    pixels = [(5.0, 4.0)] * 4 + [(-9.0, 4.0), (6.0, 22.0), (-900.0, 4.0)]
    scene = scene_at_pixels(pixels, camera, 1.0, channels=1)
    means = scene.cloud.means.clone()
    means[:4, 2] = torch.tensor([1.0, -1.0, 0.005, 0.3])
    shapes = shaped([[0.9, 0.3, 0.3]] * 7, [[0.8, 0.1, 0.5, 0.2]] * 7)
    scene = scene.with_cloud(means=means, ellipsoids=shapes, low_pass=LOW_PASS_3DGS)
    assert_agrees(scene, tolerance=TOLERANCE)
    ids = scene.forward(Cuda()).backward(scene.loss_weights()).ids
    assert ids.tolist() == [0, 3, 4, 5]


@pytest.mark.parametrize("low_pass", FILTERS)
def test_opaque_transparent_and_flat(native: NativeRenderer, low_pass: LowPass) -> None:
    """Ellipsoids without thickness, and without any size, which the reference cannot invert."""
    camera = skewed_camera(16, 12)
    pixels = [(5.0, 4.0), (6.0, 5.0), (4.0, 5.0), (7.5, 7.5), (9.0, 6.0)]
    scene = scene_at_pixels(pixels, camera, [1.0, 2.0, 1.5, 3.0, 1.2])
    shapes = shaped(
        [[0.2, 0.1, 0.1], [0.3, 0.2, 0.1], [0.1, 0.1, 0.1], [0.4, 0.2, 0.0], [0.0, 0.0, 0.0]],
        [[0.9, 0.3, 0.2, 0.1]] * 5,
    )
    logits = torch.tensor([torch.inf, 0.3, -torch.inf, 1.0, 2.0])
    scene = scene.with_cloud(opacity_logits=logits, ellipsoids=shapes, low_pass=low_pass)
    assert torch.allclose(scene.draw(Cuda()), scene.draw(native), atol=3e-5)
    weights = torch.randn(5, 12, 16, generator=torch.Generator().manual_seed(0))
    expected = gradients_of(scene, native, weights)
    assert_same_gradients(gradients_of(scene, Cuda(), weights), expected)


@pytest.mark.parametrize("group", ["means", "opacity_logits", "log_scales", "rotations"])
def test_ellipsoids_with_nan_geometry_are_ignored(group: str) -> None:
    scene = small_scene(5)
    tensors = scene.cloud.tensors()
    tensors[group] = tensors[group].clone()
    tensors[group][5] = torch.nan
    spoiled = replace(scene, cloud=scene.cloud.with_tensors(tensors))
    without = replace(scene, cloud=scene.cloud.select(torch.arange(20) != 5))
    assert torch.equal(spoiled.draw(Cuda()), without.draw(Cuda()))


def test_rows_behind_an_opaque_stack_are_zero() -> None:
    count = 40
    scene = scene_at_pixels(
        [(4 + 0.02 * k, 3 - 0.01 * k) for k in range(count)],
        skewed_camera(8, 8),
        [1.0 + 0.05 * k for k in range(count)],
        opacity=0.7,
        channels=3,
    )
    shapes = shaped([[2.0, 2.5, 3.0]] * count, [[0.9, 0.1, 0.3, 0.1]] * count)
    scene = scene.with_cloud(ellipsoids=shapes)
    error = float((scene.draw(Cuda()).double() - reference_images(scene)).abs().max())
    assert error <= 3 * MIN_TRANSMITTANCE * largest_value(scene)
    gradients = gradients_of(scene, Cuda(), scene.loss_weights())
    assert not gradients["log_scales"][32:].any() and not gradients["features"][32:].any()
    assert gradients["log_scales"][:10].all()


@pytest.mark.parametrize("count", [0, 2])
def test_nothing_in_view(count: int) -> None:
    scene = scene_at_pixels([(-500, 4), (5, 900)][:count], skewed_camera(20, 17), channels=4)
    scene = scene.with_cloud(ellipsoids=Ellipsoids.spheres(scene.cloud.log_radii, degree=1))
    drawn = scene.forward(Cuda())
    assert torch.equal(drawn.images, torch.zeros(9, 17, 20))
    gradients = drawn.backward(torch.ones(9, 17, 20))
    assert gradients.ids.numel() == 0
    assert gradients.features.shape == (0, 4)
    assert gradients.ellipsoids is not None
    assert gradients.ellipsoids.harmonics.shape == (0, 3, 3)
    assert torch.equal(gradients.T_camera_map, torch.zeros(3, 4, dtype=torch.float64))


def test_region_renders_only_its_tiles() -> None:
    scene = ellipsoid_scene(8, PIXEL_FILTER, 1, count=30, channels=1, size=(40, 20))
    region = torch.tensor([[True, False, True], [False, True, False]])
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights, region)
    assert_same_images(scene.draw(Cuda(), region), scene, reference_images(scene, region))
    assert_same_gradients(gradients_of(scene, Cuda(), weights, region), expected, TOLERANCE)


@pytest.mark.parametrize(
    "other",
    [{"side": 16, "warps": 8, "narrow_warps": 8, "channels_backward": 16}, {"batch": 32}],
)
def test_tuning_parameters_do_not_change_results(other: dict[str, int]) -> None:
    assert_agrees(small_scene(3), replace(FLOAT32, **other), TOLERANCE)


def test_the_chain_rule_is_the_same_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene(4)
    weights = scene.loss_weights()
    once = gradients_of(scene, Cuda(), weights)
    monkeypatch.setattr(ellipsoids, "_PART", 7)
    assert_same_gradients(gradients_of(scene, Cuda(), weights), once, 1e-6)


def test_centres_are_last_and_detached_features_do_not_affect_geometry() -> None:
    scene = small_scene(40)
    arguments = (scene.cloud, scene.camera, scene.T_camera_map)
    drawn = Cuda().forward(*arguments, scene.cloud.features, None, centres=True)
    expected = reference_images(scene.with_cloud(features=scene.cloud.means))[5:]
    assert torch.allclose(drawn.images[-3:].double(), expected, atol=1e-5)
    weights = scene.loss_weights()
    whole, base = drawn.backward(weights), drawn.backward(weights[:5])
    detached = drawn.backward(weights, detached=True, colours=False)
    assert detached.colours is None
    assert torch.allclose(detached.features, whole.features, atol=1e-6)
    assert_same_gradients(
        dense_gradients(replace(detached, colours=base.colours, features=base.features), 20),
        dense_gradients(base, 20),
        1e-6,
    )


def test_results_are_reproducible() -> None:
    scene = small_scene(21)
    weights = scene.loss_weights()
    once, again = (gradients_of(scene, Cuda(), weights) for _ in range(2))
    assert_identical(again, once)


def test_native_and_cuda_agree(native: NativeRenderer) -> None:
    scene = small_scene(22, PIXEL_FILTER, 3)
    weights = scene.loss_weights()
    assert torch.allclose(scene.draw(Cuda()), scene.draw(native), atol=3e-5)
    expected = gradients_of(scene, native, weights)
    assert_same_gradients(gradients_of(scene, Cuda(), weights), expected)


def test_render_has_gradients_of_shapes_and_pose() -> None:
    scene = replace(small_scene(23), cloud=small_scene(23).cloud.to(DEVICE))
    found = []
    for name in ("cuda", "reference"):
        cloud = scene.cloud.mapped(lambda tensor: tensor.clone().requires_grad_())
        pose = torch.from_numpy(scene.T_camera_map).requires_grad_()
        output = render(cloud, scene.camera, pose, features=cloud.features, backend_name=name)
        (output.colour.sum() + output.depth_sum_m.sum() + output.features.sum()).backward()
        tensors = cloud.tensors() | {"pose": pose}
        found.append({n: t.grad.cpu() for n, t in tensors.items() if n != "log_radii"})
    assert_same_gradients(*found)


@pytest.mark.skipif(DEVICE == "cpu", reason="the interpreter does not round to tf32")
@pytest.mark.parametrize("low_pass", FILTERS)
def test_tf32_error_is_bounded(low_pass: LowPass) -> None:
    scene = ellipsoid_scene(13, low_pass, channels=40)
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, Cuda(Tuning()), weights), expected, 4e-3)
