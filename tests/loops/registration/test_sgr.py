"""Both stages together, and the coarse stage alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from registered_room import Scene, error, motion, moved, seen_by

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import register_pair
from toolkit.slam.loops.registration.sgr import CoarseOnly, SemanticGuidedRegistration


@pytest.mark.parametrize("seed", range(2))
def test_submaps_find_each_other_from_nothing(room: Scene, seed):
    T_new_source = motion(seed, 1.0, 160.0)
    far = moved(room.source, T_new_source)
    result = SemanticGuidedRegistration().register(room.target, far)
    mm, deg = error(result.T_target_source, room.T_target_source @ se3.inverse(T_new_source))
    assert result.converged, result.reason
    assert mm < 3.0
    assert deg < 0.05


def test_the_smaller_submap_may_come_first(room: Scene):
    result = register_pair(SemanticGuidedRegistration(), room.source, room.target)
    truth = se3.inverse(room.T_target_source)
    assert error(result.T_target_source, truth)[0] < 2.0


def test_the_same_bits_again(room: Scene):
    registrar = SemanticGuidedRegistration()
    a, b = (registrar.register(room.target, room.source) for _ in range(2))
    assert a.T_target_source.tobytes() == b.T_target_source.tobytes()
    assert a.information.tobytes() == b.information.tobytes()


def test_submaps_of_two_cameras_find_each_other(room: Scene):
    """The source's keyframes are larger, of another focal length and principal point."""
    camera = Camera(250.0, 262.0, 110.0, 98.0, 240, 180)
    source = replace(room.source, keyframes=[seen_by(k, camera) for k in room.source.keyframes])
    result = SemanticGuidedRegistration().register(room.target, source)
    mm, deg = error(result.T_target_source, room.T_target_source)
    assert result.converged, result.reason
    assert mm < 3.0
    assert deg < 0.05


def test_a_start_serves_where_no_view_is_alike(room: Scene):
    bare = replace(room.source, descriptors=np.zeros((0, 0), np.float32))
    registrar = SemanticGuidedRegistration()
    start = room.T_target_source @ motion(2, 0.05, 2.0)
    result = registrar.register(room.target, bare, start)
    assert error(result.T_target_source, room.T_target_source)[0] < 2.0
    nothing = registrar.register(room.target, bare)
    assert not nothing.converged
    assert nothing.reason


def test_a_wrong_start_does_no_harm(room: Scene):
    start = room.T_target_source @ motion(2, 1.0, 50.0)
    result = SemanticGuidedRegistration().register(room.target, room.source, start)
    assert error(result.T_target_source, room.T_target_source)[0] < 2.0


def test_the_coarse_stage_alone_is_judged_by_looking(room: Scene, renderer):
    registrar = CoarseOnly(RegistrationOptions(views=2), renderer)
    result = registrar.register(room.target, room.source)
    assert result.converged, result.reason
    assert error(result.T_target_source, room.T_target_source)[0] < 3.0
    assert result.inliers > 0.9
    assert result.renders == renderer.renders == 4
