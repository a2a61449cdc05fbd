"""Gaussian cloud: validation, conversions, selection and rigid motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.geometry import se3
from toolkit.splatting.gaussians.cloud import NO_LOW_PASS, PARAMETERS, PIXEL_FILTER, GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids


def random_cloud(seed: int = 0, count: int = 8, channels: int = 3) -> GaussianCloud:
    rng = torch.Generator().manual_seed(seed)
    return GaussianCloud.from_values(
        torch.randn(count, 3, generator=rng),
        torch.rand(count, generator=rng) + 0.01,
        torch.rand(count, generator=rng) * 0.98 + 0.01,
        torch.rand(count, 3, generator=rng),
        torch.randn(count, channels, generator=rng),
    )


def assert_equal(a: GaussianCloud, b: GaussianCloud) -> None:
    for name in PARAMETERS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


@settings(deadline=None, max_examples=30)
@given(radius_m=st.floats(1e-5, 50.0), opacity=st.floats(1e-4, 0.999))
def test_radii_and_opacities_round_trip(radius_m: float, opacity: float) -> None:
    cloud = GaussianCloud.from_values(
        torch.zeros(1, 3), torch.tensor([radius_m]), torch.tensor([opacity]), torch.zeros(1, 3)
    )
    assert float(cloud.radii_m) == pytest.approx(radius_m, rel=1e-5)
    assert float(cloud.opacities) == pytest.approx(opacity, rel=1e-4)
    assert cloud.features.shape == (1, 0)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("means", (8, 2), r"means must have shape \[8, 3\], got \[8, 2\]"),
        ("log_radii", (8, 1), r"log_radii must have shape \[8\], got \[8, 1\]"),
        ("opacity_logits", (7,), r"opacity_logits must have shape \[8\], got \[7\]"),
        ("colours", (3, 8), r"colours must have shape \[8, 3\], got \[3, 8\]"),
        ("features", (9, 3), r"features must have shape \[8, 3\], got \[9, 3\]"),
    ],
)
def test_wrong_shapes_raise(name: str, shape: tuple[int, ...], message: str) -> None:
    cloud = random_cloud()
    parts = {n: getattr(cloud, n) for n in PARAMETERS} | {name: torch.zeros(shape)}
    with pytest.raises(ValueError, match=message):
        GaussianCloud(**parts)


def test_string_representation() -> None:
    assert str(random_cloud()) == "8 Gaussians, 3 feature channels"
    assert len(GaussianCloud.empty(5)) == 0
    assert GaussianCloud.empty(5).features.shape == (0, 5)


def test_select_by_mask_and_by_index_agree() -> None:
    cloud = random_cloud()
    mask = torch.tensor([True, False, False, True, False, True, False, False])
    assert_equal(cloud.select(mask), cloud.select(torch.tensor([0, 3, 5])))
    assert torch.equal(cloud.select(torch.tensor([5, 0])).means, cloud.means[[5, 0]])
    assert len(cloud.select(torch.zeros(8, dtype=torch.bool))) == 0


def test_select_inverts_concatenate() -> None:
    parts = [random_cloud(1, 4), GaussianCloud.empty(3), random_cloud(2, 6)]
    whole = GaussianCloud.concatenate(parts)
    assert len(whole) == 10
    assert_equal(whole.select(torch.arange(4)), parts[0])
    assert_equal(whole.select(torch.arange(4, 10)), parts[2])


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_rigid_motion_changes_only_the_means(seed: int) -> None:
    cloud = random_cloud()
    T_new_old = se3.exp(np.random.default_rng(seed).normal(size=6))
    moved = cloud.transformed(T_new_old)
    np.testing.assert_allclose(
        moved.means.numpy(), se3.transform_points(T_new_old, cloud.means.numpy()), atol=1e-5
    )
    assert moved.means.dtype == torch.float32
    for name in PARAMETERS[1:]:
        assert torch.equal(getattr(moved, name), getattr(cloud, name)), name
    back = moved.transformed(se3.inverse(T_new_old))
    np.testing.assert_allclose(back.means.numpy(), cloud.means.numpy(), atol=1e-5)


def test_gradients_are_propagated_unless_detached() -> None:
    cloud = random_cloud()
    cloud.means.requires_grad_()
    moved = cloud.transformed(np.eye(4)).select(torch.tensor([1, 2]))
    assert moved.means.requires_grad
    assert not moved.detached().means.requires_grad
    moved.means.sum().backward()
    assert cloud.means.grad is not None
    assert cloud.means.grad.sum(dim=1).tolist() == [0, 3, 3, 0, 0, 0, 0, 0]


def test_operations_keep_how_colours_were_fitted() -> None:
    cloud = replace(GaussianCloud.empty(), centred_colours=True)
    for result in (
        cloud.select(torch.zeros(0, dtype=torch.int64)),
        cloud.transformed(np.eye(4)),
        cloud.to("meta"),
        cloud.detached(),
        GaussianCloud.concatenate([cloud, cloud]),
    ):
        assert result.centred_colours
    assert not GaussianCloud.concatenate([cloud, GaussianCloud.empty()]).centred_colours


def test_spheres_do_not_decide_the_low_pass_of_ellipsoids() -> None:
    """Maps of both kinds are merged: ellipsoids look wrong with another filter, spheres do not."""
    spheres = random_cloud(count=2)
    shapes = Ellipsoids.spheres(spheres.log_radii)
    ellipsoids = replace(spheres, ellipsoids=shapes, low_pass=PIXEL_FILTER)
    for clouds in ([spheres, ellipsoids], [ellipsoids, spheres]):
        assert GaussianCloud.concatenate(clouds).pixel_filter
    assert GaussianCloud.concatenate([spheres, spheres]).low_pass == NO_LOW_PASS


def test_a_flat_ellipsoid_is_seen_as_large_as_it_is():
    # Half axes of 4, 2 and 0.1 cm; the second one is turned, so that its first axis points up.
    scales = torch.tensor([[0.04, 0.02, 0.001]] * 2)
    half = 2.0**-0.5
    rotations = torch.tensor([[1.0, 0.0, 0.0, 0.0], [half, 0.0, -half, 0.0]])
    cloud = replace(
        random_cloud(count=2), ellipsoids=Ellipsoids(scales.log(), rotations, torch.zeros(2, 0, 3))
    )
    up = np.array([0.0, 0.0, 1.0])
    assert cloud.radii_seen_m(up) == pytest.approx([(0.04 * 0.02) ** 0.5, (0.02 * 0.001) ** 0.5])
    # Between the axes, the area is that of the projected covariance.
    aslant = np.array([0.6, 0.0, 0.8])
    across = np.array([[0.0, 1.0, 0.0], [0.8, 0.0, -0.6]])
    projected = cloud.axes_m() @ across.T
    areas = np.linalg.det(projected.transpose(0, 2, 1) @ projected) ** 0.25
    assert cloud.radii_seen_m(aslant) == pytest.approx(areas)
    spheres = random_cloud(count=2)
    assert spheres.radii_seen_m(up) == pytest.approx(spheres.radii_m.numpy(), rel=1e-6)
