"""Arrival times, clocks, the record of a run, and the steps that wait."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_clock import SimulatedClock

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.deferred import DeferredSteps, StepCounts
from toolkit.slam.pacing.clock import ArrivalSchedule, MonotonicClock
from toolkit.slam.pacing.delays import FrameDelay, PaceRecord, PaceSummary, count_of
from toolkit.slam.pacing.paced import outcome_of
from toolkit.slam.result import FrameResult
from toolkit.slam.tracking.result import Health, not_tracked

ROWS = (
    FrameDelay(0, 0.0, 0.5, "keyframe"),
    FrameDelay(1, 0.1, None, "dropped"),
    FrameDelay(2, 0.2, 0.1, "tracked"),
    FrameDelay(3, 0.3, 0.2, "lost"),
)


def test_frames_arrive_at_equal_intervals_from_the_first_one():
    schedule = ArrivalSchedule(fps=20.0)
    schedule.start(index=8, now_s=100.0)
    schedule.start(index=9, now_s=500.0)
    assert schedule.arrival_s(8) == pytest.approx(100.0)
    assert schedule.arrival_s(12) == pytest.approx(100.2)
    assert schedule.camera_time_s(100.2) == pytest.approx(12 / 20)


def test_a_simulated_clock_advances_only_on_request():
    clock = SimulatedClock()
    clock.advance(0.5)
    clock.sleep_until(0.2)
    assert clock.now_s() == 0.5
    clock.sleep_until(2.0)
    assert clock.now_s() == 2.0


def test_the_clock_of_the_machine_sleeps_until_a_time():
    clock = MonotonicClock()
    begin_s = clock.now_s()
    clock.sleep_until(begin_s + 0.01)
    assert clock.now_s() >= begin_s + 0.01
    clock.sleep_until(begin_s)


def test_the_summary_counts_what_was_skipped():
    summary = PaceSummary(10.0, 0.3, ROWS, 7, StepCounts(due=20, taken=15, late=4))
    metrics = summary.metrics()["pace"]
    assert metrics["delay_median_ms"] == pytest.approx(200.0)
    assert metrics["delay_p95_ms"] == pytest.approx(470.0)
    assert metrics["delay_max_ms"] == pytest.approx(500.0)
    assert (metrics["frames_late"], metrics["frames_dropped"]) == (1, 1)
    assert metrics["keyframes_thinned"] == 7
    assert (metrics["mapping_steps_skipped"], metrics["mapping_steps_deferred"]) == (5, 4)
    assert "depend on the speed of the machine" in str(metrics["convention"])


def test_without_frames_there_is_no_delay():
    metrics = PaceSummary(10.0, 0.3, (), 0, StepCounts()).metrics()["pace"]
    assert metrics["delay_max_ms"] is None
    assert metrics["frames_dropped"] == 0


def test_delays_are_a_table():
    rows = PaceSummary(10.0, 0.3, ROWS, 0, StepCounts()).csv().splitlines()
    assert rows[0] == "frame,arrival_s,delay_s,outcome"
    assert rows[1:3] == ["0,0.000000,0.500000,keyframe", "1,0.100000,,dropped"]


def test_a_doubtful_frame_is_counted_as_such():
    doubtful = replace(not_tracked("ambiguous"), health=Health.DOUBTFUL)
    found = outcome_of(FrameResult(4, np.eye(4), doubtful))
    assert found == "doubtful"
    assert outcome_of(FrameResult(4, None, doubtful)) == "lost"
    assert outcome_of(FrameResult(4, np.eye(4), None, dropped=True)) == "dropped"
    rows = (*ROWS, FrameDelay(4, 0.4, 0.1, found))
    assert (count_of("doubtful", rows), count_of("lost", rows)) == (1, 1)
    assert PaceSummary(10.0, 0.3, rows, 0, StepCounts()).csv().splitlines()[-1].endswith("doubtful")


def test_a_record_survives_json():
    record, restored = PaceRecord(), PaceRecord()
    record.delays, record.keyframes_thinned = list(ROWS), 7
    restored.restore(json.loads(json.dumps(record.values())))
    assert restored.delays == record.delays
    assert restored.keyframes_thinned == 7


def keyframe(index: int) -> Keyframe:
    camera = Camera(1.0, 1.0, 0.0, 0.0, 1, 1)
    rgb, depth_m = torch.zeros(3, 1, 1, dtype=torch.uint8), torch.zeros(1, 1)
    points = np.zeros((0, 3), np.float32)
    return Keyframe(index, 0.1 * index, np.eye(4), rgb, depth_m, camera, IDENTITY, points)


class TestDeferredSteps:
    def test_the_newest_keyframe_comes_first(self):
        steps = DeferredSteps()
        steps.add(keyframe(0), 2)
        steps.take(steps.next())
        steps.add(keyframe(5), 1)
        order = []
        while due := steps.next():
            order.append(due.keyframe.index)
            steps.take(due)
        assert order == [5, 0]
        assert steps.counts == StepCounts(due=3, taken=3, late=1)
        assert not steps

    def test_steps_of_a_replaced_map_are_skipped(self):
        steps = DeferredSteps()
        steps.add(keyframe(0), 4)
        steps.skip(24)
        steps.clear()
        assert steps.next() is None
        assert steps.counts == StepCounts(due=28, taken=0, late=0)

    def test_no_step_is_due_for_a_keyframe_without_steps(self):
        steps = DeferredSteps()
        steps.add(keyframe(0), 0)
        assert steps.next() is None
