"""Keyframes placed by what earlier ones observed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from registered_room import Scene, error, motion, scene, seen_by, stranger

from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe, fractions_observed
from toolkit.slam.tracking import placement as placement_module
from toolkit.slam.tracking.placement import KeyframePlacement


@pytest.fixture(scope="module")
def room() -> Scene:
    return scene()


def keyframe(room: Scene, place: int) -> Keyframe:
    """One of the target's at its true pose."""
    return room.target.keyframes[place]


def moved(true: Keyframe, seed: int, metres: float = 0.01, degrees: float = 0.5) -> Keyframe:
    """A keyframe where a tracker might have put it."""
    return replace(true, T_map_camera=true.T_map_camera @ motion(seed, metres, degrees))


@pytest.mark.parametrize("seed", range(4))
def test_a_keyframe_comes_to_its_place(room: Scene, seed):
    new = moved(keyframe(room, 3), seed)
    before, _ = error(new.T_map_camera, keyframe(room, 3).T_map_camera)
    T = KeyframePlacement().place(room.target.keyframes[:3], new)
    mm, deg = error(T, keyframe(room, 3).T_map_camera)
    assert before > 9.0
    assert mm < 0.5
    assert deg < 0.02


@pytest.mark.parametrize("newest", [False, True])
def test_keyframes_of_two_cameras_are_compared(room: Scene, newest):
    """The new keyframe, or those before it, are larger and of another focal length."""
    camera = Camera(250.0, 262.0, 110.0, 98.0, 240, 180)
    earlier, new = room.target.keyframes[:3], moved(keyframe(room, 3), 0)
    if newest:
        new = seen_by(new, camera)
    else:
        earlier = [seen_by(k, camera) for k in earlier]
    placement = KeyframePlacement()
    mm, deg = error(placement.place(earlier, new), keyframe(room, 3).T_map_camera)
    assert mm < 1.0
    assert deg < 0.04


def test_exposure_of_the_two_may_differ(room: Scene):
    new = moved(keyframe(room, 3), 1)
    darker = replace(new, rgb=(new.rgb.float() * 0.8 + 10.0).round().to(torch.uint8))
    T = KeyframePlacement().place(room.target.keyframes[:3], darker)
    mm, _ = error(T, keyframe(room, 3).T_map_camera)
    assert mm < 1.0


def test_a_view_of_another_place_stays_where_it_was(room: Scene):
    T = KeyframePlacement().place(room.target.keyframes, stranger())
    assert np.array_equal(T, stranger().T_map_camera)


def test_without_earlier_ones_it_stays(room: Scene):
    new = moved(keyframe(room, 0), 2)
    assert np.array_equal(KeyframePlacement().place([], new), new.T_map_camera)


def test_a_correction_by_many_pixels_needs_clear_evidence(room: Scene):
    new = moved(keyframe(room, 3), 5, metres=0.06, degrees=4.0)
    mm, _ = error(
        KeyframePlacement().place(room.target.keyframes[:3], new), keyframe(room, 3).T_map_camera
    )
    assert mm < 0.5
    noise = torch.randint(0, 256, new.rgb.shape, generator=torch.manual_seed(0))
    changed = replace(new, rgb=noise.to(new.rgb.dtype))
    T = KeyframePlacement().place(room.target.keyframes[:3], changed)
    assert np.array_equal(T, changed.T_map_camera)


def test_features_start_what_the_tracker_missed(room: Scene):
    true = keyframe(room, 3)
    new, near = moved(true, 6, metres=0.25, degrees=14.0), moved(true, 1).T_map_camera
    placement, earlier = KeyframePlacement(), room.target.keyframes[:3]
    assert np.array_equal(placement.place(earlier, new), new.T_map_camera)
    mm, _ = error(placement.place(earlier, new, near), true.T_map_camera)
    assert mm < 0.5


@pytest.fixture
def contradicted(monkeypatch):
    """Older keyframes contradict the recent ones: no pose fits all of them."""
    aligned = KeyframePlacement._aligned

    def failing(self, chosen, new, start):
        found = aligned(self, chosen, new, start)
        return replace(found, converged=len(chosen) <= 2)

    monkeypatch.setattr(KeyframePlacement, "_aligned", failing)


@pytest.mark.parametrize(("metres", "degrees", "moves"), [(0.08, 3.0, True), (0.04, 1.5, False)])
def test_recent_keyframes_decide_about_jumps(room: Scene, contradicted, metres, degrees, moves):
    new = moved(keyframe(room, 3), 1, metres, degrees)
    T = KeyframePlacement().place(room.target.keyframes[:3], new)
    mm, _ = error(T, keyframe(room, 3).T_map_camera)
    assert mm < 0.5 if moves else np.array_equal(T, new.T_map_camera)


@pytest.mark.parametrize("agree", [False, True])
def test_with_features_recent_keyframes_decide_about_less(room: Scene, contradicted, agree):
    true = keyframe(room, 3)
    new, near = moved(true, 1, 0.04, 1.5), moved(true, 2, 0.002, 0.1).T_map_camera
    T = KeyframePlacement().place(
        room.target.keyframes[:3], new, near if agree else new.T_map_camera
    )
    mm, _ = error(T, true.T_map_camera)
    assert mm < 0.5 if agree else np.array_equal(T, new.T_map_camera)


def test_a_keyframe_of_other_surfaces_is_ignored(room: Scene, monkeypatch):
    """Far from its true pose, a keyframe does not show the surfaces of the new one."""
    wrong = replace(keyframe(room, 1), T_map_camera=motion(3, 0.8, 20.0))
    new = moved(keyframe(room, 3), 6)
    monkeypatch.setattr(placement_module, "_RECENT", 1)
    monkeypatch.setattr(placement_module, "_EVERY", 1)
    placement = KeyframePlacement()
    alone = placement.place([keyframe(room, 2)], new)
    beside = placement.place([wrong, keyframe(room, 2)], new)
    assert np.array_equal(alone, beside)


def test_what_was_held_changes_no_bit(room: Scene):
    placement = KeyframePlacement()
    news = [moved(keyframe(room, place), place) for place in (1, 2, 3)]
    held = [placement.place(room.target.keyframes[:n], new) for n, new in enumerate(news, 1)]
    for n, new in enumerate(news, 1):
        afresh = KeyframePlacement().place(room.target.keyframes[:n], new)
        assert np.array_equal(held[n - 1], afresh)


def test_a_keyframe_observed_its_own_points_and_none_before_or_behind(room: Scene):
    own = keyframe(room, 2)
    points = own.points_in_map()
    assert fractions_observed([own], points)[0] > 0.95
    camera = own.T_map_camera[:3, 3]
    for stretch in (0.8, 1.2):
        assert fractions_observed([own], camera + stretch * (points - camera))[0] < 0.2
    assert fractions_observed([own], np.zeros((0, 3)))[0] == 0.0


def test_several_keyframes_are_compared_as_each_alone(room: Scene):
    points = keyframe(room, 2).points_in_map()
    others = [keyframe(room, place) for place in (1, 3)]
    others[1] = replace(others[1], camera=replace(others[1].camera, fx=0.9 * others[1].camera.fx))
    together = fractions_observed(others, points)
    assert together.tolist() == [fractions_observed([k], points)[0] for k in others]
    assert together[0] > 0.5
