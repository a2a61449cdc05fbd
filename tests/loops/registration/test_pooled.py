"""Features of many pairs together."""

from __future__ import annotations

import numpy as np
from registered_room import Scene, error, motion, moved

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.slam.loops.registration.coarse import register_coarse
from toolkit.slam.loops.registration.motion_average import SIGMA_M
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.pooled import pooled_motion
from toolkit.splatting.alignment import matching
from toolkit.splatting.alignment.health import HealthLimits

# What the coarse stage's information claims of a hypothesis: features alone are no better in so
# small images, and the fine stage begins there.
SIGMA_MM = 1000.0 * SIGMA_M


def keyframes(room: Scene) -> list[tuple[Keyframe, Keyframe]]:
    return list(zip(room.target.keyframes, room.source.keyframes, strict=False))


def test_pairs_find_the_motion_together(room: Scene, generator, stranger):
    """One of them shows another room, at a pose that means nothing."""
    pairs = [*keyframes(room), (room.target.keyframes[0], stranger)]
    found = pooled_motion(pairs, generator)
    assert found is not None
    mm, deg = error(found.T_target_source, room.T_target_source)
    assert mm < SIGMA_MM
    assert deg < 0.3
    assert 3 not in found.pairs


def test_another_room_is_rejected(room: Scene, generator, stranger):
    pairs = [(keyframe, stranger) for keyframe in room.target.keyframes]
    assert pooled_motion(pairs, generator) is None


def test_a_single_pair_is_not_sufficient(room: Scene, generator):
    assert pooled_motion(keyframes(room)[:1], generator) is None


def test_nothing_matches_nothing(generator):
    assert pooled_motion([], generator) is None


def test_the_same_seed_gives_the_same_bits(room: Scene):
    a, b = (pooled_motion(keyframes(room), np.random.default_rng(3)) for _ in range(2))
    assert a is not None
    assert b is not None
    assert a.T_target_source.tobytes() == b.T_target_source.tobytes()


def test_the_coarse_stage_asks_it_where_no_pair_is_sure(room: Scene, generator, monkeypatch):
    T_new_source = motion(4, 7.0, 150.0)
    far = moved(room.source, T_new_source)
    # Every dense alignment is rejected, so that no pair has an offset of its own.
    monkeypatch.setattr(matching, "_LIMITS", HealthLimits(min_visible=1.1))
    found = register_coarse(room.target, far, RegistrationOptions(), generator)
    assert found.result.converged
    truth = room.T_target_source @ se3.inverse(T_new_source)
    camera = far.keyframes[0].T_map_camera
    mm, _ = error(found.result.T_target_source @ camera, truth @ camera)
    assert mm < SIGMA_MM
    assert np.linalg.eigvalsh(found.result.information)[0] > 0
