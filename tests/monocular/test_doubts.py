"""When a motion without depth is called unreliable."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.monocular.loop_closure import LoopClosure
from toolkit.depth.monocular.motion import CameraMotion, doubts_about

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
PATH = Trajectory(np.arange(10.0), np.tile(np.eye(4), (10, 1, 1)))


@pytest.mark.parametrize(
    ("revisits", "rejected", "doubted"),
    [
        # office0, the HoloLens walk: right scales.
        (27, 2, False),
        (127, 8, False),
        # Walks through rooms whose scale drifted by a quarter, and to the threefold.
        (54, 20, True),
        (14, 5, True),
        # Few contradictions may be accidents.
        (2, 3, False),
        (0, 4, True),
    ],
)
def test_revisits_that_contradict_the_motion_make_it_unreliable(revisits, rejected, doubted):
    motion = CameraMotion(
        PATH, CAMERA, [], 10, extent=1.0, error_px=0.3, loops=LoopClosure(revisits, rejected)
    )
    doubts = doubts_about(motion)
    assert bool(doubts) == doubted
    if doubted:
        assert f"{rejected} of {revisits + rejected} pairs" in doubts[0]


def test_a_motion_without_loops_is_reliable():
    assert not doubts_about(CameraMotion(PATH, CAMERA, [], 10, extent=1.0, error_px=0.3))
