"""Keyframes: overlap, when a frame becomes one, and which ones a call works on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.keyframes import choose_window, is_revisit, seen_fraction
from toolkit.slam.mapping.options import KeyframePolicy

CAMERA = Camera(40.0, 40.0, 31.5, 23.5, 64, 48)


def keyframe(index: int = 0, T_map_camera: np.ndarray | None = None) -> Keyframe:
    """A view of a wall two metres ahead."""
    rgb = np.random.default_rng(index).random((48, 64, 3), dtype=np.float32)
    frame = Frame(index, index / 30.0, rgb, np.full((48, 64), 2.0, dtype=np.float32), CAMERA)
    return Keyframe.from_frame(frame, np.eye(4) if T_map_camera is None else T_map_camera)


def turned(degrees: float) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(degrees), 0.0]))


class TestOverlap:
    def test_the_same_place_sees_everything(self):
        pose = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
        assert keyframe(T_map_camera=pose).fraction_seen_by(pose) == 1.0

    def test_it_falls_as_the_camera_turns_away(self):
        shares = [keyframe().fraction_seen_by(turned(angle)) for angle in (0, 15, 30, 45, 60)]
        assert shares == sorted(shares, reverse=True)
        assert 0.3 < shares[2] < 0.8 and shares[-1] < 0.3  # true shares: 0.5, 0.25

    def test_what_lies_behind_is_not_seen(self):
        assert keyframe().fraction_seen_by(turned(180)) == 0.0
        beyond = np.eye(4)
        beyond[2, 3] = 3.0
        assert keyframe().fraction_seen_by(beyond) == 0.0

    def test_half_an_image_sideways_is_half_the_view(self):
        aside = np.eye(4)
        aside[0, 3] = 32 * 2.0 / 40.0
        assert keyframe().fraction_seen_by(aside) == pytest.approx(0.5, abs=0.13)

    def test_a_frame_without_depth_overlaps_nothing(self):
        blind = replace(keyframe(), points=np.zeros((0, 3), dtype=np.float32))
        assert blind.fraction_seen_by(np.eye(4)) == 0.0


class TestKeyframe:
    def test_the_image_survives_to_eight_bits(self):
        rgb = np.random.default_rng(0).random((48, 64, 3), dtype=np.float32)
        target = keyframe().target_rgb().permute(1, 2, 0).numpy()
        assert abs(target - rgb).max() < 0.51 / 255

    def test_the_target_has_the_exposure_of_the_map(self):
        plain = keyframe()
        bright = replace(plain, exposure=Exposure(1.5, -0.1))
        expected = 1.5 * plain.target_rgb() - 0.1
        assert (bright.target_rgb() - expected).abs().max() < 1e-6

    def test_the_pose_is_its_own(self):
        pose = np.eye(4)
        one = keyframe(T_map_camera=pose)
        pose[0, 3] = 9.0
        assert np.array_equal(one.T_map_camera, np.eye(4))

    def test_it_comes_back_from_a_checkpoint(self):
        one = keyframe(3, turned(20))
        other = Keyframe.from_state(one.arrays(), one.values())
        assert other.values() == one.values()
        for name, array in one.arrays().items():
            assert np.array_equal(other.arrays()[name], array), name
            assert other.arrays()[name].dtype == array.dtype


@pytest.mark.parametrize(
    ("frames", "overlap", "wanted"),
    [
        (1, 1.0, False),
        (4, 0.9, False),
        (5, 1.0, True),
        (9, 0.1, True),
        (1, 0.79, True),
        (1, 0.8, False),
    ],
)
def test_a_keyframe_comes_by_time_or_by_overlap(frames, overlap, wanted):
    assert KeyframePolicy(interval=5, min_overlap=0.8).wants(frames, overlap) is wanted


class TestRevisit:
    def path(self, degrees: float = 3.0) -> list[Keyframe]:
        """Turning to the right, at 40 poses."""
        return [keyframe(i, turned(degrees * i)) for i in range(40)]

    def test_an_earlier_view_comes_again(self):
        assert is_revisit(self.path(), turned(10.0), 0.05)
        assert not is_revisit(self.path(), turned(-4.0), 0.05)

    def test_the_newest_keyframes_are_no_earlier_visit(self):
        assert not is_revisit(self.path(), turned(3.0 * 39), 0.05)
        assert not is_revisit(self.path()[:20], turned(0.0), 0.05)

    def test_those_of_an_earlier_visit_count(self):
        path = self.path()[:20]
        assert is_revisit(path, turned(0.0), 0.05, visited=1)
        assert not is_revisit(path, turned(6.0), 0.05, visited=1)

    def test_a_camera_that_rests_has_a_limited_number_of_keyframes(self):
        resting = [keyframe(i) for i in range(21)]
        assert not is_revisit(resting[:20], np.eye(4), 0.05)
        assert is_revisit(resting, np.eye(4), 0.05)

    def test_a_nearer_view_is_a_new_one(self):
        nearer = se3.exp(np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0]))  # of two metres
        assert not is_revisit(self.path(), nearer, 0.05)
        assert is_revisit(self.path(), nearer, 0.07)

    def test_all_views_are_new_without_a_limit(self):
        assert not is_revisit(self.path(), np.eye(4), 0.0)


class TestSeen:
    """Views of a wall two metres ahead; 64 pixels are 77 degrees."""

    def seen(self, keyframes: list[Keyframe], pose: np.ndarray) -> float:
        return seen_fraction(keyframes, keyframe(99).as_frame(), pose)

    def test_what_one_has_measured_is_seen(self):
        assert self.seen([keyframe()], np.eye(4)) == 1.0
        aside = np.eye(4)
        aside[0, 3] = 32 * 2.0 / 40.0
        assert self.seen([keyframe()], aside) == pytest.approx(0.5, abs=0.05)

    def test_all_that_are_near_count(self):
        left, right = np.eye(4), np.eye(4)
        left[0, 3], right[0, 3] = -0.8, 0.8
        views = [keyframe(0, left), keyframe(1, right)]
        assert self.seen(views[:1], np.eye(4)) < 0.8
        assert self.seen(views, np.eye(4)) > 0.98

    def test_a_surface_behind_another_is_not_seen(self):
        before = keyframe()
        before.depth_m.fill_(1.0)
        assert self.seen([before], np.eye(4)) == 0.0

    def test_from_much_nearer_a_surface_is_a_new_one(self):
        nearer = se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
        frame = replace(keyframe(99).as_frame(), depth_m=np.full((48, 64), 1.0, np.float32))
        assert seen_fraction([keyframe()], frame, nearer) == 0.0

    def test_without_depth_nothing_is_seen(self):
        frame = replace(keyframe(99).as_frame(), depth_m=np.zeros((48, 64), np.float32))
        assert seen_fraction([keyframe()], frame, np.eye(4)) == 0.0


class TestWindow:
    def path(self, count: int = 20) -> list[Keyframe]:
        """Turning away from the start: early ones no longer overlap the newest."""
        return [keyframe(i, turned(5.0 * i)) for i in range(count)]

    def chosen(self, seed: int, size: int = 6, min_overlap: float = 0.5) -> list[int]:
        generator = np.random.default_rng(seed)
        return [k.index for k in choose_window(self.path(), size, min_overlap, generator)]

    def test_the_newest_comes_first_and_none_twice(self):
        window = self.chosen(0)
        assert window[0] == 19
        assert len(set(window)) == len(window) == 6

    def test_a_generator_decides(self):
        assert self.chosen(1) == self.chosen(1)
        assert len({tuple(self.chosen(seed)) for seed in range(8)}) > 1

    def test_those_that_see_the_same_place_come_first(self):
        path = self.path()
        newest = path[-1]
        sharing = {k.index for k in path if newest.fraction_seen_by(k.T_map_camera) > 0.5}
        assert 4 <= len(sharing) < 15, "the test needs both kinds"
        for seed in range(5):
            assert set(self.chosen(seed, size=4)) <= sharing

    def test_one_keyframe_is_a_window(self):
        window = choose_window([keyframe()], 8, 0.5, np.random.default_rng(0))
        assert [k.index for k in window] == [0]

    def test_a_window_of_one_is_the_newest(self):
        assert self.chosen(0, size=1) == [19]

    def test_a_short_sequence_is_used_whole(self):
        still = [keyframe(i) for i in range(4)]
        window = choose_window(still, 8, 0.5, np.random.default_rng(0))
        assert sorted(k.index for k in window) == [0, 1, 2, 3]


def test_exposures_compose_and_invert():
    image = np.linspace(0.0, 1.0, 7, dtype=np.float32)
    inner, outer = Exposure(1.4, -0.1), Exposure(0.7, 0.05)
    both = outer.after(inner)
    assert np.allclose(both.apply(image), outer.apply(inner.apply(image)))
    assert np.allclose(both.undo(both.apply(image)), image, atol=1e-6)
