"""Depth of images from other images at known poses."""

from __future__ import annotations

import numpy as np
import pytest
from moving_camera import film, walk

from toolkit.alignment.levels import intensity_of
from toolkit.depth_priors import plane_sweep as module
from toolkit.depth_priors.multi_view import DepthView, MultiViewDepth
from toolkit.depth_priors.plane_sweep import plane_sweep
from toolkit.errors import DependencyError
from toolkit.geometry import se3
from toolkit.native import available_instruction_sets, load_variant

POSES = walk(9)[::2]
FRAMES = film(POSES)
IMAGES = [intensity_of(frame.rgb).numpy() for frame in FRAMES]
RANGE = (0.2, 1.0)


def sources(reference: int, *others: int) -> list:
    T_world_reference = POSES[reference]
    return [(IMAGES[n], se3.inverse(POSES[n]) @ T_world_reference) for n in others]


def relative_error(inverse_depth: np.ndarray, number: int) -> np.ndarray:
    known = inverse_depth > 0
    return (
        np.abs(1.0 / inverse_depth[known] - FRAMES[number].depth_m[known])
        / (FRAMES[number].depth_m[known])
    )


@pytest.mark.parametrize("name", available_instruction_sets())
def test_depth_is_found_nearly_everywhere(name, monkeypatch):
    monkeypatch.setattr(module, "require_kernels", lambda: load_variant(name))
    found = plane_sweep(FRAMES[2].camera, IMAGES[2], sources(2, 0, 1, 3, 4), RANGE, 48)
    error = relative_error(found.inverse_depth, 2)
    assert (found.inverse_depth > 0).mean() > 0.9
    assert np.median(error) < 0.015
    assert (error > 0.2).mean() < 0.05


def test_a_hidden_or_unrelated_source_does_no_harm():
    """The two best sources count."""
    noise = np.random.default_rng(0).random(IMAGES[0].shape, np.float32)
    others = [*sources(2, 0, 4), (noise, np.eye(4))]
    found = plane_sweep(FRAMES[2].camera, IMAGES[2], others, RANGE, 48)
    assert np.median(relative_error(found.inverse_depth, 2)) < 0.015


def test_instruction_sets_agree(monkeypatch):
    results = []
    for name in available_instruction_sets():
        monkeypatch.setattr(module, "require_kernels", lambda name=name: load_variant(name))
        results.append(plane_sweep(FRAMES[1].camera, IMAGES[1], sources(1, 0, 3), RANGE, 32))
    for other in results[1:]:
        same = np.isclose(other.inverse_depth, results[0].inverse_depth, rtol=0.01)
        assert same.mean() > 0.98
        assert np.abs(other.correlation - results[0].correlation).mean() < 1e-3


def test_pixels_that_no_source_shows_have_no_depth():
    away = se3.exp([0, 0, 0, 0, np.pi, 0])
    found = plane_sweep(FRAMES[0].camera, IMAGES[0], [(IMAGES[1], away)], RANGE, 16)
    assert not found.inverse_depth.any()


def test_surfaces_nearer_than_the_nearest_plane_have_no_depth():
    found = plane_sweep(FRAMES[2].camera, IMAGES[2], sources(2, 0, 4), (0.05, 0.25), 32)
    nearer = FRAMES[2].depth_m < 2.0
    assert (found.inverse_depth[nearer] == 0).mean() > 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sources": []}, "needs a source"),
        ({"inverse_depths": (0.5, 0.5)}, "needs a source"),
        ({"planes": 1}, "needs a source"),
        ({"intensity": IMAGES[0].astype(np.float64)}, "float32 of shape"),
        ({"intensity": IMAGES[0][:-1]}, "float32 of shape"),
    ],
)
def test_unusable_input_is_rejected(arguments, message):
    usual = {"intensity": IMAGES[0], "sources": sources(0, 1), "inverse_depths": RANGE, "planes": 8}
    with pytest.raises(ValueError, match=message):
        plane_sweep(FRAMES[0].camera, **(usual | arguments))


def test_without_kernels_there_is_a_remedy(monkeypatch):
    monkeypatch.setattr("toolkit.native.loading.kernels", lambda: None)
    with pytest.raises(DependencyError, match=r"g\+\+"):
        plane_sweep(FRAMES[0].camera, IMAGES[0], sources(0, 1), RANGE, 8)


def multi_view(poses: np.ndarray = POSES) -> MultiViewDepth:
    views = [DepthView(n, T, 1.2, 4.0) for n, T in enumerate(poses)]
    return MultiViewDepth(FRAMES[0].camera, views, lambda frame: IMAGES[frame])


def test_neighbouring_keyframes_confirm_depth():
    depth = multi_view().depth(2)
    known = depth > 0
    error = np.abs(depth - FRAMES[2].depth_m)[known] / FRAMES[2].depth_m[known]
    assert known.mean() > 0.6
    assert np.median(error) < 0.01
    assert (error > 0.2).mean() < 0.01


def test_depth_scales_with_the_poses():
    larger = POSES.copy()
    larger[:, :3, 3] *= 3.0
    views = [DepthView(n, T, 3.6, 12.0) for n, T in enumerate(larger)]
    scaled = MultiViewDepth(FRAMES[0].camera, views, lambda frame: IMAGES[frame]).depth(2)
    usual = multi_view().depth(2)
    both = (scaled > 0) & (usual > 0)
    assert np.median(scaled[both] / usual[both]) == pytest.approx(3.0, rel=1e-3)


def test_wrong_poses_are_not_confirmed():
    rng = np.random.default_rng(2)
    shaken = np.array([T @ se3.exp(rng.normal(0.0, 0.05, 6)) for T in POSES])
    assert (multi_view(shaken).depth(2) > 0).mean() < 0.5 * (multi_view().depth(2) > 0).mean()
