"""The keyframes that relocalisation tries, and their order."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.loops import relocalisation
from toolkit.slam.loops.candidates import SimilarKeyframe
from toolkit.slam.loops.relocalisation import Relocaliser
from toolkit.slam.tracking.reach import Reach
from toolkit.slam.tracking.result import Health
from toolkit.splatting.alignment.similarity import Similarity

CAMERA = Camera(20.0, 20.0, 7.5, 5.5, 16, 12)
# Keyframes by index, in one submap: metres from its origin along x.
POSITIONS_M = {10: 9.0, 20: 0.0, 30: 4.0, 40: 1.0, 50: 7.0}


def lost_frame(timestamp_s: float) -> Frame:
    return Frame(
        99, timestamp_s, np.zeros((12, 16, 3), np.float32), np.ones((12, 16), np.float32), CAMERA
    )


def at(x_m: float) -> np.ndarray:
    return se3.exp(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0]))


class Detector:
    """Keyframes in the order of their index are less and less similar."""

    def most_similar(self, keyframe, count):
        return [SimilarKeyframe(i, 0, i / 100.0) for i in POSITIONS_M][:count]


class Map:
    """A submap at 1 m, whose keyframes are at `POSITIONS_M`."""

    def keyframe_poses(self, number):
        return {index: at(x_m) for index, x_m in POSITIONS_M.items()}

    def T_world_submap(self, number):
        return at(1.0)

    def submap(self, number):
        keyframes = [
            SimpleNamespace(index=index, T_map_camera=at(x_m)) for index, x_m in POSITIONS_M.items()
        ]
        return SimpleNamespace(number=number, keyframes=keyframes, gaussians=None)


@pytest.fixture
def tried(monkeypatch):
    """Indices of the keyframes that a frame was matched with, in order; the matching fails."""
    indices: list[int] = []
    monkeypatch.setattr(relocalisation, "_TRIES", 2)
    monkeypatch.setattr(relocalisation, "_SEEN_FROM_M", 0.5)
    monkeypatch.setattr(
        relocalisation, "measure_offset", lambda keyframe, *_: indices.append(keyframe.index)
    )
    return indices


def within(metres: float) -> Reach:
    """The camera is near the keyframe of index 20: distances from it are `POSITIONS_M`."""
    return Reach(at(1.0), metres, np.pi)


def find(reach, part=(0,), tracker=None):
    return Relocaliser(Detector()).find(lost_frame(0.0), Map(), tracker, reach, part)


def test_the_most_similar_keyframes_are_tried_alone(tried):
    assert find(None) is None
    assert tried == [10, 20]


@pytest.mark.parametrize(
    ("metres", "expected"), [(1.0, [20, 40]), (3.5, [20, 30]), (8.5, [10, 20]), (-0.6, [])]
)
def test_keyframes_out_of_reach_are_not_tried(tried, metres, expected):
    find(within(metres))
    assert tried == expected


def test_keyframes_of_other_parts_are_not_tried(tried):
    find(within(9.0), part=(7,))
    assert tried == []


class Tracker:
    """Finds a frame where it starts, or moved by a motion [4, 4]."""

    def __init__(self, likenesses=(), T_moved=None, **changes):
        values = {"health": Health.GOOD, "visible_fraction": 0.9, "intensity_residual": 0.02}
        self.values, self.likenesses = values | changes, list(likenesses)
        self.T_moved = np.eye(4) if T_moved is None else T_moved

    def locate(self, frame, gaussians, start, search):
        values = self.values | {"similarity": None}
        if self.likenesses:
            like = self.likenesses.pop(0)
            values["similarity"] = Similarity(like, like, 100, 1.0, 1.0)
        return SimpleNamespace(T_map_camera=start @ self.T_moved, **values)


@pytest.fixture
def near_each(monkeypatch):
    """Matching finds every frame 25 cm beside each keyframe that it is matched with."""
    monkeypatch.setattr(
        relocalisation, "measure_offset", lambda *_: SimpleNamespace(T_first_second=at(0.25))
    )


@pytest.mark.parametrize(
    ("likenesses", "position_m"),
    [((0.9, 0.9), None), ((0.9, 0.88), None), ((0.9, 0.8), 9.25), ((0.8, 0.9), 0.25)],
)
def test_of_two_places_the_frame_must_look_like_one(near_each, likenesses, position_m, monkeypatch):
    monkeypatch.setattr(relocalisation, "_TRIES", 2)
    result = find(within(20.0), tracker=Tracker(likenesses))
    assert (result is None) == (position_m is None)
    if result is not None:
        assert result.T_submap_camera[0, 3] == pytest.approx(position_m)


@pytest.mark.parametrize("turned_rad", [0.0, 0.5])
def test_keyframes_of_one_place_confirm_each_other(near_each, turned_rad, monkeypatch):
    monkeypatch.setattr(relocalisation, "_TRIES", 2)
    turns = iter([0.0, turned_rad])
    monkeypatch.setattr(
        relocalisation,
        "measure_offset",
        lambda keyframe, _: SimpleNamespace(
            T_first_second=se3.inverse(keyframe.T_map_camera)
            @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, next(turns), 0.0]))
        ),
    )
    result = find(within(20.0), tracker=Tracker((0.9, 0.9)))
    assert (result is not None) == (turned_rad == 0.0), "another direction is another place"


def test_a_pose_out_of_reach_shows_a_place_that_looks_the_same(near_each):
    assert find(within(1.5), tracker=Tracker()) is not None
    assert find(within(1.5), tracker=Tracker(T_moved=at(3.0))) is None


@pytest.mark.parametrize(("metres", "found"), [(3.0, True), (3.9, False)])
def test_a_place_that_looks_alike_may_be_on_the_other_side(near_each, monkeypatch, metres, found):
    # The frame looks like two places that are 4 m apart. The camera may be 4 m before the first.
    for index in (10, 40, 50):
        monkeypatch.delitem(POSITIONS_M, index)
    reach = Reach(at(1.0 - 0.4), metres, np.pi)
    result = Relocaliser(Detector()).find(lost_frame(0.0), Map(), Tracker((0.9, 0.9)), reach, (0,))
    assert (result is not None) == found


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, True),
        ({"visible_fraction": relocalisation._MIN_VISIBLE}, True),
        ({"intensity_residual": relocalisation._MAX_INTENSITY_RESIDUAL}, True),
        ({"visible_fraction": 0.3}, False),
        ({"intensity_residual": 0.2}, False),
        ({"health": Health.DOUBTFUL}, False),
    ],
)
def test_only_reliable_poses_are_accepted(near_each, changes, found):
    result = find(None, tracker=Tracker(**changes))
    assert (result is not None) == found
    if result is not None:
        assert result.T_submap_camera[0, 3] in (9.25, 0.25, 4.25, 1.25, 7.25)
