"""Registration of bare clouds by Open3D."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from registered_room import Scene, error, motion, moved

from benchmarks.loops import cloud_registration
from benchmarks.loops.cloud_registration import CloudRegistration, scaled_information
from toolkit.base.geometry import se3


@pytest.mark.parametrize("search", ["ransac", "fast"])
def test_clouds_find_each_other_from_nothing(room: Scene, search, monkeypatch):
    T_new_source = motion(2, 1.0, 70.0)
    far = moved(room.source, T_new_source)
    monkeypatch.setattr(cloud_registration, "_VOXEL_M", 0.08)
    registrar = CloudRegistration(search)
    result = registrar.register(room.target, far)
    mm, deg = error(result.T_target_source, room.T_target_source @ se3.inverse(T_new_source))
    assert result.converged, result.reason
    assert mm < 15.0
    assert deg < 0.3
    again = registrar.register(room.target, far)
    assert again.T_target_source.tobytes() == result.T_target_source.tobytes()


def test_coloured_icp_refines_a_start(room: Scene):
    registrar = CloudRegistration(icp="coloured")
    start = room.T_target_source @ motion(1, 0.04, 2.0)
    result = registrar.register(room.target, room.source, start)
    assert error(result.T_target_source, room.T_target_source)[0] < 15.0


def test_an_empty_submap_is_no_cloud(room: Scene):
    none = room.source.gaussians.select(room.source.gaussians.opacities < 0)
    result = CloudRegistration().register(room.target, replace(room.source, gaussians=none))
    assert not result.converged
    assert "Gaussians" in result.reason


@given(st.integers(0, 1000))
def test_information_is_that_of_the_points(seed):
    """Against a sum of J^T J of the residuals p_target - T exp(x) p_source, built here."""
    generator = np.random.default_rng(seed)
    source, T, rmse_m = generator.normal(size=(20, 3)), motion(seed, 3.0, 130.0), 0.02
    count = np.zeros((6, 6))
    expected = np.zeros((6, 6))
    for point in source:
        moved_point = se3.transform_points(T, point)
        J = np.hstack([-se3.hat(moved_point), np.eye(3)])  # Open3D: left, rotation first
        count += J.T @ J
        ours = T[:3, :3] @ np.hstack([np.eye(3), -se3.hat(point)])
        expected += ours.T @ ours
    found = scaled_information(count, T, rmse_m)
    np.testing.assert_allclose(found, expected * 3.0 / rmse_m**2, rtol=1e-8, atol=1e-6)
