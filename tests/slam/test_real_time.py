"""SLAM at camera rate, on a simulated clock on which its stages take given times."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from simulated_clock import SimulatedClock
from slam_room import FEW, SlamRoom, blind_frames

from toolkit.base.frame import Frame
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import KeyframePolicy, MapperOptions
from toolkit.slam.pacing.options import PacingOptions
from toolkit.slam.pacing.paced import PacedSlam
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.placement import KeyframePlacement

FPS = 20.0
# Seconds that the stages take; a step is timed as "map forward".
FAST = {"tracking": 0.01, "placing": 0.02, "map forward": 0.001}


class SimulatedStages:
    """A recorder that advances a clock by the given duration of each stage."""

    def __init__(self, clock: SimulatedClock, durations_s: dict[str, float]) -> None:
        self.clock, self.durations_s = clock, durations_s

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        yield
        self.clock.advance(self.durations_s.get(stage, 0.0))


def paced(durations_s: dict[str, float], options: MapperOptions = FEW) -> PacedSlam:
    clock = SimulatedClock()
    stages = SimulatedStages(clock, durations_s)
    mapper = Mapper(options, np.random.default_rng(0), recorder=stages)
    slam = Slam(FrontEnd(DenseTracker(), placement=KeyframePlacement()), mapper, recorder=stages)
    return PacedSlam(slam, FPS, PacingOptions(max_delay_s=0.2), clock)


def fed(system: PacedSlam, frames: list[Frame], hold_out: int | None = None):
    return [
        system.process_frame(f, may_map=not (hold_out and f.index % hold_out == hold_out - 1))
        for f in system.arriving(frames)
    ]


def outcomes(system: PacedSlam) -> list[str]:
    return [row.outcome for row in system.summary().delays]


def delays_s(system: PacedSlam) -> list[float]:
    return [row.delay_s for row in system.summary().delays if row.delay_s is not None]


def test_a_fast_machine_skips_nothing(room: SlamRoom):
    system = paced(FAST)
    results = fed(system, room.frames)
    summary = system.summary()
    assert not any(result.lost or result.dropped for result in results)
    assert summary.keyframes_thinned == 0
    while system.work():
        pass
    assert summary.steps.taken == summary.steps.due > 20
    for row in summary.delays[1:]:
        placed_s = 0.021 if row.outcome == "keyframe" else 0.0
        assert row.delay_s == pytest.approx(0.01 + placed_s)
        assert row.arrival_s == pytest.approx(row.index / FPS)


def test_idle_time_is_spent_on_steps_that_fit_into_it(room: SlamRoom):
    """19 ms remain after the second frame: one step of 15 ms fits."""
    system = paced({"tracking": 0.031, "map forward": 0.015})
    fed(system, room.frames[:3])
    # One step while the keyframe was added, then two before the second frame.
    assert system.summary().steps.taken == 1 + 2 + 1
    assert delays_s(system)[1:] == pytest.approx([0.031, 0.031])


def test_keyframes_are_postponed_before_frames_are_dropped(room: SlamRoom):
    """In the time of a keyframe, two more frames arrive; tracking catches up slowly."""
    system = paced({"tracking": 0.045, "placing": 0.09})
    fed(system, room.frames)
    summary = system.summary()
    assert summary.dropped == 0
    assert summary.keyframes_thinned > 0
    assert 1 < outcomes(system).count("keyframe") < 5
    assert max(delays_s(system)) <= 0.2


class TestOverload:
    """Tracking takes twice as long as frames take to arrive."""

    SLOW: ClassVar = {"tracking": 0.1, "map forward": 0.001}

    def test_frames_are_dropped_so_that_the_delay_is_bounded(self, room: SlamRoom):
        system = paced(self.SLOW)
        fed(system, room.frames)
        assert system.summary().dropped >= 4
        assert max(delays_s(system)) <= 0.2 + 1e-9
        assert delays_s(system)[-1] > 0.1

    def test_dropped_frames_have_the_last_pose(self, room: SlamRoom):
        system = paced(self.SLOW)
        results = fed(system, room.frames)
        result = system.slam.result()
        dropped = [r.index for r in results if r.dropped]
        assert result.dropped_frames == dropped
        assert result.frame_indices == list(range(14))
        poses = result.trajectory.T_world_camera
        for index in dropped:
            assert np.array_equal(poses[index], poses[index - 1])
            assert np.allclose(results[index].T_world_camera, poses[index])
        assert not result.lost_frames
        assert len(system.slam.finish().trajectory) == 14

    def test_the_newest_frame_is_processed_however_slow_tracking_is(self, room: SlamRoom):
        system = paced({"tracking": 0.3})
        fed(system, room.frames)
        assert outcomes(system).count("tracked") >= 2

    def test_an_urgent_keyframe_is_added_within_the_bound(self, room: SlamRoom):
        """Frames are dropped first, so that there is time for it."""
        options = replace(FEW, keyframes=KeyframePolicy(interval=2, min_overlap=0.0))
        system = paced({"tracking": 0.055, "placing": 0.12}, options=options)
        fed(system, room.frames)
        found = outcomes(system)
        urgent = found.index("keyframe", found.index("dropped"))
        assert found[urgent - 2 : urgent] == ["dropped"] * 2
        assert system.summary().keyframes_thinned >= 2
        assert max(delays_s(system)) <= 0.2 + 1e-9


def test_held_out_frames_are_not_mapped(room: SlamRoom):
    system = paced(FAST)
    fed(system, room.frames, hold_out=2)
    keyframes = system.slam.result().keyframe_indices
    assert len(keyframes) > 1
    assert all(index % 2 == 0 for index in keyframes)


class TestLost:
    def test_frames_dropped_while_lost_are_lost(self, room: SlamRoom):
        """They do not count as attempts to locate the camera."""
        system = paced(FAST)
        fed(system, room.frames[:6])
        far = replace(room.frames[6], depth_m=room.frames[6].depth_m + 5.0)
        assert system.process_frame(far).lost
        assert system.slam._path.unreliable_in_a_row == 1
        dropped = system.slam.drop_frame(room.frames[7])
        assert dropped.lost and dropped.dropped
        assert system.slam._path.unreliable_in_a_row == 1
        result = system.slam.result()
        assert list(result.lost_frames)[-1] == 7
        assert result.dropped_frames[-1] == 7

    def test_the_frame_after_a_recovery_is_processed(self, room: SlamRoom):
        """The motion model needs it. Later frames are dropped until the delay is bounded."""
        system = paced(FAST)
        fed(system, room.frames[:6])
        fed(system, blind_frames(room.frames[6:7]))
        assert isinstance(system.clock, SimulatedClock)
        system.clock.advance(0.6)
        # Four more frames make a gap that tracking bridges.
        fed(system, room.frames[7:14])
        assert outcomes(system)[6:] == ["lost", *["dropped"] * 4, "tracked", "tracked", "dropped"]

    def test_before_the_first_map_frames_are_lost(self, room: SlamRoom):
        system = paced(FAST)
        results = fed(system, blind_frames(room.frames[:1]))
        assert results[0].lost
        assert system.slam.drop_frame(room.frames[1]).lost


def test_a_resumed_run_continues_the_record(room: SlamRoom):
    durations_s = {"tracking": 0.1, "map forward": 0.001}
    whole, begun, resumed = (paced(durations_s) for _ in range(3))
    fed(whole, room.frames)
    fed(begun, room.frames[:8])
    arrays, values = begun.state()
    resumed.restore(arrays, json.loads(json.dumps(values)))
    resumed.clock.sleep_until(50.0)
    fed(resumed, room.frames[8:])
    delays = resumed.summary().delays
    assert delays[:8] == begun.summary().delays
    # The frame at which the run continues arrives at once, at its time on the camera's clock.
    assert delays[8].arrival_s == pytest.approx(8 / FPS)
    assert delays[8].delay_s == pytest.approx(0.1, abs=0.002)
    assert resumed.summary().steps.due >= begun.summary().steps.due
    assert resumed.slam.result().frame_indices == list(range(14))


def test_images_of_a_camera_are_processed_when_they_arrive(room: SlamRoom):
    """The caller waits for images and knows when they arrived."""
    system = paced(FAST)
    system.process_frame(room.frames[0], arrival_s=system.clock.now_s())
    taken = 0
    while system.work():
        taken += 1
    assert taken == FEW.first_iterations
    arrival_s = system.clock.now_s() - 0.03
    system.process_frame(room.frames[1], arrival_s=arrival_s)
    assert delays_s(system)[1] == pytest.approx(0.04)


def test_two_runs_on_equal_clocks_are_identical(room: SlamRoom):
    """Real time is not reproducible only because of the times of the machine."""
    paths = []
    for _ in range(2):
        system = paced({"tracking": 0.06, "placing": 0.05, "map forward": 0.003})
        fed(system, room.frames[:9])
        paths.append(system.slam.result().trajectory.T_world_camera)
    assert np.array_equal(*paths)
