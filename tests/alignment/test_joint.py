"""One motion from many pairs of views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from registered_room import Scene, error, motion

from toolkit.base.geometry import se3
from toolkit.splatting.alignment import joint
from toolkit.splatting.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import keyframe_level, model_level, pyramid

LEVELS = 3


def pair_of(submaps: Scene, i: int, j: int) -> Pair:
    """Observed keyframe i of the target against observed keyframe j of the source."""
    first, second = submaps.target.keyframes[i], submaps.source.keyframes[j]
    model = [model_level(level) for level in pyramid(keyframe_level(first), LEVELS)]
    frame = pyramid(keyframe_level(second), LEVELS)
    return Pair(model, frame, se3.inverse(first.T_map_camera), second.T_map_camera)


@pytest.fixture(scope="module")
def pairs(submaps: Scene) -> list[Pair]:
    return [pair_of(submaps, 3, 0), pair_of(submaps, 2, 1), pair_of(submaps, 1, 2)]


OPTIONS = JointOptions(levels=LEVELS)


@pytest.mark.parametrize("seed", range(3))
def test_pairs_together_find_the_motion_they_share(submaps: Scene, pairs, seed):
    start = submaps.T_target_source @ motion(seed, 0.04, 2.0)
    found = align(pairs, Estimate(start), OPTIONS)
    mm, deg = error(found.T_target_source, submaps.T_target_source)
    assert found.converged
    assert mm < 0.5
    assert deg < 0.02


def test_the_motion_does_not_depend_on_the_submaps_frames(submaps: Scene, pairs):
    T_new_source, T_other_target = motion(5, 3.0, 100.0), motion(6, 2.0, 80.0)
    T_target_other = se3.inverse(T_other_target)
    start = submaps.T_target_source @ motion(1, 0.03, 1.0)
    once = replace(OPTIONS, iterations=1)
    found = align(pairs, Estimate(start), once)
    transformed = [
        replace(
            pair,
            T_model_target=pair.T_model_target @ T_target_other,
            T_source_frame=T_new_source @ pair.T_source_frame,
        )
        for pair in pairs
    ]
    other = align(transformed, Estimate(T_other_target @ start @ se3.inverse(T_new_source)), once)
    A = se3.adjoint(se3.inverse(T_new_source))
    np.testing.assert_allclose(
        T_target_other @ other.T_target_source @ T_new_source, found.T_target_source, atol=1e-4
    )
    scale = np.abs(other.information).max()
    np.testing.assert_allclose(
        other.information, A.T @ found.information @ A, atol=1e-2 * scale, rtol=0.02
    )


def test_every_pair_has_an_exposure_of_its_own(submaps: Scene, pairs):
    dim = [replace(level, intensity=0.8 * level.intensity + 0.05) for level in pairs[1].frame]
    changed = [pairs[0], replace(pairs[1], frame=dim), pairs[2]]
    start = submaps.T_target_source @ motion(1, 0.02, 1.0)
    found = align(changed, Estimate(start), OPTIONS)
    assert error(found.T_target_source, submaps.T_target_source)[0] < 0.5
    assert found.exposures[1] == pytest.approx([1.25, -0.0625], abs=0.03)
    assert found.exposures[0] == pytest.approx([1.0, 0.0], abs=0.02)


def test_no_step_is_longer_than_allowed(submaps: Scene, pairs, monkeypatch):
    start = submaps.T_target_source @ motion(1, 0.1, 4.0)
    monkeypatch.setattr(joint, "_MAX_TRANSLATION_M", 0.01)
    found = align(pairs, Estimate(start), replace(OPTIONS, levels=1, iterations=1))
    assert error(found.T_target_source, start)[0] <= 10.0 + 1e-6


def test_views_of_nothing_move_nothing(submaps: Scene, pairs):
    empty = [replace(level, depth_m=0 * level.depth_m) for level in pairs[0].frame]
    found = align([replace(pairs[0], frame=empty)], Estimate(submaps.T_target_source), OPTIONS)
    assert not found.converged
    np.testing.assert_array_equal(found.T_target_source, submaps.T_target_source)


def tilted(pair: Pair) -> Pair:
    """The pair with depth that is 3 % too large on the right side, and too small on the left."""
    frame = []
    for level in pair.frame:
        across = torch.linspace(-1.0, 1.0, level.camera.width)
        frame.append(replace(level, depth_m=level.depth_m * (1.0 + 0.03 * across)))
    return replace(pair, frame=frame)


def test_colour_outweighs_depth_with_errors_across_the_image(submaps: Scene, pairs):
    distorted = [tilted(pair) for pair in pairs]
    errors = []
    for weight in (1.0, 0.05):
        options = replace(OPTIONS, geometric_weight=weight)
        found = align(distorted, Estimate(submaps.T_target_source), options)
        errors.append(error(found.T_target_source, submaps.T_target_source)[0])
    assert errors[1] < 0.5 * errors[0]
