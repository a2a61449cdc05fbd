"""The keyframes that relocalisation tries, and their order."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.frame import Frame
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.loops import relocalisation
from toolkit.loops.candidates import SimilarKeyframe
from toolkit.loops.options import RelocalisationOptions
from toolkit.loops.relocalisation import LastPosition, Relocaliser
from toolkit.tracking.result import Health

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
    monkeypatch.setattr(relocalisation, "_SLACK_M", 1.5)
    monkeypatch.setattr(
        relocalisation, "measure_offset", lambda keyframe, *_: indices.append(keyframe.index)
    )
    return indices


def last_at(timestamp_s, part=(0,)):
    return LastPosition(timestamp_s, ORIGIN, part)


def find(last, timestamp_s=0.0, anywhere=True, tracker=None):
    relocaliser = Relocaliser(Detector())
    return relocaliser.find(lost_frame(timestamp_s), Map(), tracker, last, anywhere)


def test_the_most_similar_keyframes_are_tried_alone(tried):
    assert find(None) is None
    assert tried == [10, 20]


# The keyframes' distances from the last position are those of `POSITIONS_M`.
ORIGIN = np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("elapsed_s", "expected"),
    [(0.0, [20, 40]), (1.0, [20, 40]), (1.25, [20, 30]), (-1.25, [20, 30]), (3.75, [10, 20])],
)
def test_the_reach_grows_with_time(tried, elapsed_s, expected):
    find(last_at(100.0), 100.0 + elapsed_s, anywhere=False)
    assert tried == expected


def test_keyframes_out_of_reach_are_not_tried(tried):
    find(last_at(100.0), 100.0)
    assert tried == [20, 40]


def test_keyframes_of_other_parts_come_after_those_in_reach(tried):
    find(last_at(100.0, part=(7,)), 100.0)
    assert tried == [20, 40, 10]


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, True),
        ({"visible_fraction": RelocalisationOptions().min_visible}, True),
        ({"intensity_residual": relocalisation._MAX_INTENSITY_RESIDUAL}, True),
        ({"visible_fraction": 0.3}, False),
        ({"intensity_residual": 0.2}, False),
        ({"health": Health.DOUBTFUL}, False),
    ],
)
def test_only_reliable_poses_are_accepted(monkeypatch, changes, found):
    T_first_second = at(0.25)
    offset = SimpleNamespace(T_first_second=T_first_second)
    monkeypatch.setattr(relocalisation, "measure_offset", lambda *_: offset)
    values = {"health": Health.GOOD, "visible_fraction": 0.9, "intensity_residual": 0.02}

    class Tracker:
        def locate(self, frame, gaussians, start, search):
            return SimpleNamespace(T_map_camera=start, **(values | changes))

    result = find(None, tracker=Tracker())
    assert (result is not None) == found
    if result is not None:
        assert np.allclose(result.T_submap_camera, at(9.25))
