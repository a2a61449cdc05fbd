"""A motion from the keyframes that look most alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from registered_room import Scene, error, motion, moved, thumbnail

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration import coarse
from toolkit.slam.loops.registration.coarse import descriptor_pairs, register_coarse
from toolkit.slam.loops.registration.options import RegistrationOptions

NOWHERE_NEAR = motion(4, 7.0, 150.0)


def elsewhere(room: Scene) -> tuple[Scene, np.ndarray]:
    """The same with the source expressed in a distant frame, and the true motion to it."""
    far = replace(room, source=moved(room.source, NOWHERE_NEAR))
    return far, room.T_target_source @ se3.inverse(NOWHERE_NEAR)


@given(st.integers(1, 8), st.integers(1, 8), st.integers(1, 10), st.integers(0, 1000))
def test_pairs_are_one_to_one_in_rounds_and_nearest_first(room: Scene, rows, columns, count, seed):
    generator = np.random.default_rng(seed)
    a, b = (generator.normal(size=(n, 5)).astype(np.float32) for n in (rows, columns))
    target = replace(room.target, descriptors=a)
    source = replace(room.source, descriptors=b)
    pairs = descriptor_pairs(target, source, count)
    assert len(pairs) == min(rows * columns, count)
    assert len({(p.target, p.source) for p in pairs}) == len(pairs)
    first = pairs[: min(rows, columns)]
    assert len({p.target for p in first}) == len({p.source for p in first}) == len(first)
    distances = [p.distance for p in first]
    assert distances == sorted(distances)
    every = np.linalg.norm(a[:, None].astype(float) - b[None], axis=2)
    assert np.isclose(distances[0], every.min(), atol=1e-4)


def test_enough_pairs_that_agree_spare_the_others(room: Scene, generator, monkeypatch):
    monkeypatch.setattr(coarse, "_ENOUGH", 2)
    few = register_coarse(room.target, room.source, RegistrationOptions(), generator)
    assert len(few.views) == 2
    assert few.result.inliers == 1.0
    assert error(few.result.T_target_source, room.T_target_source)[0] < 1.0


def test_measured_offsets_find_the_motion_from_anywhere(room: Scene, generator):
    far, truth = elsewhere(room)
    found = register_coarse(far.target, far.source, RegistrationOptions(), generator)
    mm, deg = error(found.result.T_target_source, truth)
    assert found.result.converged
    assert mm < 10.0  # the frame's origin is 7 m from the views
    assert deg < 0.05
    assert sorted(found.views) == [0, 1, 2]


def test_alike_views_are_not_equal_poses(room: Scene, generator):
    """The paper's form is off by as much as the pairs stand apart."""
    form = RegistrationOptions(offsets="none")
    biased = register_coarse(room.target, room.source, form, generator).result
    ours = register_coarse(room.target, room.source, RegistrationOptions(), generator).result
    assert error(biased.T_target_source, room.T_target_source)[0] > 15.0
    assert error(ours.T_target_source, room.T_target_source)[0] < 1.0


def test_a_look_alike_from_another_room_is_ignored(room: Scene, generator, stranger):
    keyframes = [*room.source.keyframes, stranger]
    # It claims to look exactly like the target's first keyframe.
    words = np.vstack([room.source.descriptors, thumbnail(room.target.keyframes[0])])
    mixed = replace(room.source, keyframes=keyframes, descriptors=words)
    found = register_coarse(room.target, mixed, RegistrationOptions(), generator)
    assert error(found.result.T_target_source, room.T_target_source)[0] < 1.0
    assert 3 not in found.views
    assert found.result.inliers < 1.0


def test_without_descriptors_it_says_so(room: Scene, generator):
    bare = replace(room.source, descriptors=np.zeros((0, 0), np.float32))
    found = register_coarse(room.target, bare, RegistrationOptions(), generator)
    assert not found.result.converged
    assert "descriptor" in found.result.reason


def test_a_single_pair_is_not_sufficient(room: Scene, generator, monkeypatch):
    monkeypatch.setattr(coarse, "_POOLED_PAIRS", 1)
    one = RegistrationOptions(views=1)
    found = register_coarse(room.target, room.source, one, generator)
    assert not found.result.converged
    assert "1 of 1" in found.result.reason
    assert error(found.result.T_target_source, room.T_target_source)[0] < 1.0


def test_more_pairs_help_where_the_most_similar_one_does_not_suffice(room: Scene, generator):
    options = RegistrationOptions(views=1)
    found = register_coarse(room.target, room.source, options, generator)
    assert found.result.converged
    assert error(found.result.T_target_source, room.T_target_source)[0] < 20.0
