"""Depth of keyframes that the keyframes around confirm."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from swept_box import CAMERA, FAR, FRAMES, IMAGES, NEAR, POSES, use_kernels

from toolkit.base.geometry import se3
from toolkit.depth.depth_priors.multi_view import MultiViewDepth, SweptKeyframe


def multi_view(poses: np.ndarray = POSES, scale: float = 1.0) -> MultiViewDepth:
    views = [SweptKeyframe(n, T, scale * NEAR, scale * FAR) for n, T in enumerate(poses)]
    return MultiViewDepth(CAMERA, views, lambda frame: IMAGES[frame])


def test_neighbouring_keyframes_confirm_depth():
    depth = multi_view().depth(2)
    known = depth > 0
    error = np.abs(depth - FRAMES[2].depth_m)[known] / FRAMES[2].depth_m[known]
    assert known.mean() > 0.6
    assert np.median(error) < 0.008
    assert (error > 0.2).mean() < 0.01


def test_depth_scales_with_the_poses():
    larger = POSES.copy()
    larger[:, :3, 3] *= 3.0
    scaled, usual = multi_view(larger, 3.0).depth(2), multi_view().depth(2)
    both = (scaled > 0) & (usual > 0)
    assert np.median(scaled[both] / usual[both]) == pytest.approx(3.0, rel=1e-3)


def test_wrong_poses_are_not_confirmed():
    rng = np.random.default_rng(2)
    shaken = np.array([T @ se3.exp(rng.normal(0.0, 0.05, 6)) for T in POSES])
    assert (multi_view(shaken).depth(2) > 0).mean() < 0.5 * (multi_view().depth(2) > 0).mean()


def test_errors_are_within_the_stated_accuracy():
    found = multi_view().measured(2)
    known = found.depth > 0
    assert np.isinf(found.relative_sigma[~known]).all()
    assert not found.inferred.any()
    error = np.abs(found.depth / FRAMES[2].depth_m - 1.0)[known]
    sigma = found.relative_sigma[known]
    # The estimated accuracy assumes the noise of real images.
    assert (error < sigma).mean() > 0.65
    assert (error < 2 * sigma).mean() > 0.9
    accurate = sigma < np.median(sigma)
    assert np.median(error[accurate]) < np.median(error[~accurate])


def test_the_number_of_threads_does_not_matter():
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(multi_view().measured(2))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(results[0].depth, results[1].depth)
    np.testing.assert_array_equal(results[0].relative_sigma, results[1].relative_sigma)


def test_a_machine_without_kernels_uses_the_reference(monkeypatch):
    views = [SweptKeyframe(n, T, NEAR, FAR) for n, T in enumerate(POSES[1:4])]
    usual = MultiViewDepth(CAMERA, views, lambda frame: IMAGES[frame + 1]).measured(1)
    use_kernels(monkeypatch, None)
    found = MultiViewDepth(CAMERA, views, lambda frame: IMAGES[frame + 1]).measured(1)
    both = (found.depth > 0) & (usual.depth > 0)
    assert both.mean() > 0.98 * (usual.depth > 0).mean()
    assert np.median(np.abs(found.depth[both] / usual.depth[both] - 1)) < 1e-3
