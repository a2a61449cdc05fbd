"""Ellipsoids with view-dependent colours, and low-pass filters, in value and in gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from splat_scenes import (
    Scene,
    assert_same_gradients,
    assert_same_images,
    dense_images,
    ellipsoid_scene,
    exact,
    gradients_of,
    random_scene,
    reference_images,
)

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.harmonics import harmonic_rotation
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, NO_LOW_PASS, GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import (
    HARMONIC_COUNTS,
    Ellipsoids,
    harmonic_basis,
    quaternions,
    rotation_matrices,
)
from toolkit.splatting.rendering import render
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend

FILTERS = [NO_LOW_PASS, LOW_PASS_3DGS, LowPass(0.1, compensated=True)]


def assert_agrees(native: NativeRenderer, scene: Scene) -> None:
    assert_same_images(scene.draw(native), scene, reference_images(scene))
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, native, weights), expected, 5e-4)


@pytest.mark.parametrize("low_pass", FILTERS)
@pytest.mark.parametrize("seed", range(3))
def test_the_reference_follows_the_equations(low_pass: LowPass, seed: int) -> None:
    scene = ellipsoid_scene(seed, low_pass)
    expected = torch.from_numpy(dense_images(scene))
    assert_same_images(reference_images(scene), scene, expected)


@pytest.mark.parametrize("low_pass", FILTERS)
@pytest.mark.parametrize("degree", range(4))
def test_native_ellipsoids(native: NativeRenderer, low_pass: LowPass, degree: int) -> None:
    assert_agrees(native, ellipsoid_scene(10 + degree, low_pass, degree))


@pytest.mark.parametrize("channels", [0, 1, 17])
@pytest.mark.parametrize("size", [(1, 40), (33, 1), (31, 35)])
def test_any_number_of_channels_and_size(
    native: NativeRenderer, channels: int, size: tuple[int, int]
) -> None:
    assert_agrees(native, ellipsoid_scene(channels, LOW_PASS_3DGS, channels=channels, size=size))


@pytest.mark.parametrize("low_pass", FILTERS[1:])
def test_filtered_spheres(native: NativeRenderer, low_pass: LowPass) -> None:
    scene = random_scene(3).with_cloud(low_pass=low_pass)
    assert_same_images(reference_images(scene), scene, torch.from_numpy(dense_images(scene)))
    assert_agrees(native, scene)


def test_thin_ellipses_cover_their_tiles(native: NativeRenderer) -> None:
    """Needles across many tiles, at all angles."""
    camera = Camera(100.0, 100.0, 60.0, 50.0, 121, 101)
    angles = torch.linspace(0, np.pi, 9)[:8]
    zero = torch.zeros(8)
    shapes = Ellipsoids(
        torch.tensor([[0.4, 0.002, 0.002]]).log().expand(8, 3).contiguous(),
        torch.stack([(angles / 2).cos(), zero, zero, (angles / 2).sin()], dim=1),
        torch.zeros(8, 0, 3),
    )
    means = torch.stack([0.02 * angles, -0.01 * angles, 1 + 0.01 * angles], dim=1)
    cloud = GaussianCloud.from_values(
        means, torch.full((8,), 0.01), torch.full((8,), 0.6), torch.ones(8, 3)
    )
    scene = Scene(cloud, camera, np.eye(4)).with_cloud(ellipsoids=shapes, low_pass=LOW_PASS_3DGS)
    assert_agrees(native, scene)
    assert int((scene.draw(native)[4] > 0.3).sum()) > 500


def test_compensation_keeps_the_sum_of_opacity(native: NativeRenderer) -> None:
    """A faint Gaussian far below the size of a pixel adds the same light as a sharp one."""
    camera = Camera(100.0, 100.0, 20.0, 20.0, 41, 41)

    def light(sigma_px: float, low_pass: LowPass, shape: bool) -> float:
        cloud = GaussianCloud.from_values(
            torch.tensor([[0.0, 0.0, 1.0]]),
            torch.tensor([sigma_px / 100.0]),
            torch.tensor([0.9]),
            torch.ones(1, 3),
        )
        scene = Scene(cloud, camera, np.eye(4)).with_cloud(low_pass=low_pass)
        if shape:
            scene = scene.with_cloud(ellipsoids=Ellipsoids.spheres(cloud.log_radii))
        return float(scene.draw(native)[4].sum())

    for shape in (False, True):
        exact_light = 0.9 * 2 * np.pi * 0.5**2
        assert light(0.5, LowPass(0.3, compensated=True), shape) == pytest.approx(
            exact_light, rel=0.05
        )
        assert light(0.5, LowPass(0.3), shape) > 1.5 * exact_light


def test_an_ellipsoid_with_equal_axes_on_the_axis_is_a_sphere(native: NativeRenderer) -> None:
    camera = Camera(100.0, 100.0, 20.0, 20.0, 41, 41)
    cloud = GaussianCloud.from_values(
        torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.05]), torch.tensor([0.9]), torch.ones(1, 3)
    )
    sphere = Scene(cloud, camera, np.eye(4))
    same = sphere.with_cloud(ellipsoids=Ellipsoids.spheres(cloud.log_radii))
    torch.testing.assert_close(same.draw(native), sphere.draw(native), atol=1e-5, rtol=0)


def test_render_has_gradients_of_shapes() -> None:
    scene = ellipsoid_scene(4, LOW_PASS_3DGS, degree=2)
    shapes = scene.cloud.ellipsoids
    assert shapes is not None
    leaves = shapes.mapped(lambda tensor: tensor.clone().requires_grad_())
    cloud = scene.with_cloud(ellipsoids=leaves).cloud
    render(cloud, scene.camera, scene.T_camera_map).colour.sum().backward()
    for leaf in (leaves.log_scales, leaves.rotations, leaves.harmonics):
        assert leaf.grad is not None
        assert float(leaf.grad.abs().max()) > 0


@pytest.mark.parametrize("degree", range(4))
def test_a_moved_map_looks_the_same(native: NativeRenderer, degree: int) -> None:
    scene = ellipsoid_scene(degree, LOW_PASS_3DGS, degree)
    T_new_old = se3.exp(np.array([0.4, -0.2, 0.3, 0.5, -1.0, 0.8]))
    moved = Scene(
        scene.cloud.transformed(T_new_old),
        scene.camera,
        scene.T_camera_map @ se3.inverse(T_new_old),
    )
    torch.testing.assert_close(moved.draw(native), scene.draw(native), atol=2e-4, rtol=1e-4)


def test_harmonics_are_the_real_spherical_harmonics() -> None:
    """Up to signs and order, which are those of splat files."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for n in range(1, 4):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            part = value.imag if m < 0 else value.real
            expected.append(part * (1.0 if m == 0 else 2**0.5))
    actual = harmonic_basis(torch.from_numpy(d), 15).numpy().T
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_rotated_harmonics_keep_their_norm() -> None:
    R = se3.exp(np.array([0, 0, 0, 0.3, -0.7, 1.1]))[:3, :3]
    M = harmonic_rotation(R, 15)
    np.testing.assert_allclose(M @ M.T, np.eye(15), atol=1e-12)


def test_clouds_of_spheres_and_ellipsoids_can_be_joined() -> None:
    scene = ellipsoid_scene(0, LOW_PASS_3DGS, degree=1, count=5)
    joined = GaussianCloud.concatenate([scene.cloud, random_scene(1, count=3).cloud])
    assert joined.ellipsoids is not None
    assert joined.ellipsoids.degree == 1
    assert len(joined.select(torch.tensor([0, 7])).as_ellipsoids()) == 2


def test_quaternions_of_rotations_by_any_angle() -> None:
    """Half turns as well, where the real part is zero."""
    generator = np.random.default_rng(0)
    halves = [np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])]
    R = np.array([*halves, *Rotation.random(50, generator).as_matrix()])
    found = rotation_matrices(torch.from_numpy(quaternions(R))).numpy()
    np.testing.assert_allclose(found, R, atol=1e-12)


def test_quaternions_of_any_length() -> None:
    q = torch.randn(4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(rotation_matrices(3.0 * q), rotation_matrices(q))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="rotations"):
        Ellipsoids(torch.zeros(2, 3), torch.zeros(3, 4), torch.zeros(2, 0, 3))
    with pytest.raises(ValueError, match="harmonics"):
        Ellipsoids(torch.zeros(2, 3), torch.zeros(2, 4), torch.zeros(2, 4, 3))
    assert HARMONIC_COUNTS == (0, 3, 8, 15)
