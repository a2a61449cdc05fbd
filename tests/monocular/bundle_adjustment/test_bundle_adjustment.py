"""Poses and inverse depths from image points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import CAMERA, disturbed, scene

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.depth.monocular.bundle_adjustment import native, reference
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions, Observations
from toolkit.depth.monocular.bundle_adjustment.solver import adjust

PRECISE = BundleOptions(iterations=50, min_decrease=1e-12)


def test_exact_image_points_give_the_exact_scene():
    truth = scene()
    found = adjust(disturbed(truth), PRECISE)
    np.testing.assert_allclose(found.T_world_camera, truth.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(found.inverse_depth, truth.landmarks.inverse_depth, atol=1e-6)
    assert found.error_px.max() < 1e-3
    assert found.converged


def test_fixed_poses_do_not_change():
    problem = disturbed(scene(noise_px=0.5))
    found = adjust(problem)
    np.testing.assert_array_equal(found.T_world_camera[:2], problem.T_world_camera[:2])
    assert found.cost < found.cost_before


def test_wrong_matches_have_little_influence():
    truth = scene()
    observations = truth.observations
    px = observations.px.copy()
    px[::13] += [40.0, -25.0]
    wrong = replace(truth, observations=replace(observations, px=px))
    found = adjust(disturbed(wrong), PRECISE)
    np.testing.assert_allclose(
        found.T_world_camera[:, :3, 3], truth.T_world_camera[:, :3, 3], atol=0.01
    )
    assert (found.error_px[::13] > 20.0).all()


@pytest.mark.parametrize("factor", [0.8, 1.3])
def test_the_focal_length_is_found_with_its_uncertainty(factor):
    truth = scene(poses=8, landmarks=150, noise_px=0.3)
    camera = replace(CAMERA, fx=CAMERA.fx / factor, fy=CAMERA.fy / factor)
    # Only the first pose is known: the second one follows from the focal length.
    fixed = np.arange(8) < 1
    problem = replace(disturbed(truth, 0.2), camera=camera, fixed=fixed)
    found = adjust(problem, replace(PRECISE, focal=True, iterations=200))
    assert found.focal_factor == pytest.approx(factor, rel=0.02)
    assert abs(np.log(found.focal_factor / factor)) < 4.0 * found.focal_sigma


def test_without_parallax_the_focal_length_is_not_determined():
    truth = scene(poses=2)
    found = adjust(replace(truth, fixed=np.array([True, False])), replace(PRECISE, focal=True))
    moving = adjust(replace(scene(poses=8), fixed=np.arange(8) < 1), replace(PRECISE, focal=True))
    assert found.focal_sigma > 3.0 * moving.focal_sigma


def test_a_prior_holds_what_image_points_do_not_determine():
    """Points that one image shows have the depth of their prior."""
    truth = scene(poses=2, landmarks=30)
    nothing = Observations(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)))
    prior = np.stack([np.full(30, 0.5), np.full(30, 4.0)], 1)
    marks = replace(truth.landmarks, prior=prior)
    found = adjust(replace(truth, landmarks=marks, observations=nothing), PRECISE)
    np.testing.assert_allclose(found.inverse_depth, 0.5, atol=1e-6)
    np.testing.assert_array_equal(found.T_world_camera, truth.T_world_camera)


def test_points_behind_a_camera_do_not_attract_it():
    truth = scene()
    T = truth.T_world_camera.copy()
    T[4] = T[4] @ np.diag([-1.0, 1.0, -1.0, 1.0])  # looks backwards
    found = adjust(replace(truth, T_world_camera=T))
    assert (found.error_px[truth.observations.pose == 4] == 1000.0).all()
    assert np.isfinite(found.T_world_camera).all()


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("focal", [False, True])
def test_kernels_agree_with_the_reference(name, focal):
    problem = disturbed(scene(landmarks=25, noise_px=0.4))
    prior = np.stack([np.full(25, 0.4), np.linspace(0.0, 50.0, 25)], 1)
    problem = replace(problem, landmarks=replace(problem.landmarks, prior=prior))
    options = BundleOptions(iterations=6, focal=focal)
    found = native.adjust(load_variant(name), problem, options)
    expected = reference.adjust(problem, options)
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-7)
    np.testing.assert_allclose(found.inverse_depth, expected.inverse_depth, atol=1e-7)
    np.testing.assert_allclose(found.error_px, expected.error_px, atol=1e-5)
    assert found.cost == pytest.approx(expected.cost, rel=1e-6)
    assert found.focal_factor == pytest.approx(expected.focal_factor, rel=1e-6)
    assert found.focal_sigma == pytest.approx(expected.focal_sigma, rel=1e-4)
    assert found.iterations == expected.iterations


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fixed": np.zeros(3, bool)}, "fixed must have shape"),
        ({"pose": np.array([9], np.int32)}, "pose must be in"),
        ({"landmark": np.array([60], np.int32)}, "landmark must be in"),
    ],
)
def test_inconsistent_problems_are_rejected(change, message):
    truth = scene()
    one = {"landmark": np.array([0], np.int32), "pose": np.array([2], np.int32)}
    if "fixed" not in change:
        change = {"observations": Observations(**(one | change), px=np.zeros((1, 2)))}
    with pytest.raises(ValueError, match=message):
        replace(truth, **change)


def test_observations_must_follow_the_order_of_landmarks():
    truth = scene()
    pair = Observations(np.array([1, 0], np.int32), np.array([2, 2], np.int32), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="order of their landmarks"):
        replace(truth, observations=pair)


def test_an_anchor_is_not_observed():
    truth = scene()
    own = truth.landmarks.anchor[:1]
    with pytest.raises(ValueError, match="in the anchor"):
        replace(truth, observations=Observations(np.array([0], np.int32), own, np.zeros((1, 2))))


def test_a_machine_without_kernels_uses_the_reference(monkeypatch):
    monkeypatch.setattr("toolkit.depth.monocular.bundle_adjustment.solver.kernels", lambda: None)
    truth = scene(poses=3, landmarks=12)
    found = adjust(disturbed(truth, 0.3), PRECISE)
    np.testing.assert_allclose(found.inverse_depth, truth.landmarks.inverse_depth, atol=1e-5)
