"""Readout time of a rolling shutter and delay of depth, estimated from frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving_room import MovingRoom

from toolkit.datasets.shutter import estimate
from toolkit.datasets.shutter.estimate import ShutterEstimate, estimate_shutter

FOUND = ShutterEstimate(0.02, 0.001, 0.003, 0.0005, period_s=0.033)


def times(count: int = 48, hertz: float = 30.0) -> np.ndarray:
    return np.arange(count) / hertz


@pytest.mark.parametrize(
    ("hertz", "readout_ms"), [(30, 0), (30, 10), (30, 20), (30, 30), (15, 0), (15, 30), (60, 15)]
)
def test_the_readout_does_not_depend_on_the_frame_rate(hertz, readout_ms):
    found = estimate_shutter(MovingRoom(times(hertz=hertz), 1e-3 * readout_ms))
    assert 1e3 * found.readout_s == pytest.approx(readout_ms, abs=1.0)
    assert 1e3 * found.delay_s == pytest.approx(0.0, abs=2.0)
    assert 1e3 * found.certain_readout_s == pytest.approx(readout_ms, abs=1.0)


def test_every_second_frame_has_the_same_readout():
    first, rest = (MovingRoom(times(96)[start::2], 0.02) for start in (0, 1))
    for frames in (first, rest):
        assert estimate_shutter(frames).readout_s == pytest.approx(0.02, abs=1e-3)


def test_depth_may_be_exposed_before_colour():
    found = estimate_shutter(MovingRoom(times(), 0.015, delay_s=-0.008))
    assert found.readout_s == pytest.approx(0.015, abs=1e-3)
    assert found.delay_s == pytest.approx(-0.008, abs=2e-3)
    assert "before colour" in str(found)


def test_windows_contain_no_dropped_frames():
    kept = np.ones(90, np.bool_)
    kept[[13, 14, 40, 62]] = False
    stamps = times(90)[kept]
    starts = estimate._window_starts(stamps)
    assert len(starts) >= 4
    assert all(np.ptp(np.diff(stamps[start : start + 12])) < 1e-6 for start in starts)
    found = estimate_shutter(MovingRoom(stamps, 0.02))
    assert found.readout_s == pytest.approx(0.02, abs=1e-3)


def test_wrong_times_give_no_readout():
    taken = times(96)
    # Every third image is missing, but the frames are numbered in a row.
    taken = taken[np.arange(96) % 3 != 2]
    found = estimate_shutter(MovingRoom(times(len(taken)), 0.02, taken_s=taken))
    assert found.certain_readout_s == 0.0


def test_a_window_ends_at_an_image_that_was_delivered_twice():
    taken = times(12)
    taken[9] = taken[8]
    (window,) = estimate._windows(MovingRoom(times(12), 0.02, taken_s=taken), [0])
    assert window is not None and len(window.levels) == 9
    taken[4] = taken[3]
    assert estimate._windows(MovingRoom(times(12), 0.02, taken_s=taken), [0]) == []


def test_a_still_camera_has_no_readout():
    still = MovingRoom(times(), 0.03, taken_s=np.zeros(48))
    assert estimate_shutter(still).fault


def test_frames_without_smooth_surfaces_have_no_readout():
    class Stripes(MovingRoom):
        """Depth in pairs of columns, as on walls that recede steeply: no pixel has a normal."""

        def __getitem__(self, index):
            frame = super().__getitem__(index)
            measured = np.arange(frame.depth_m.shape[1]) % 4 < 2
            return replace(frame, depth_m=np.where(measured, frame.depth_m, np.float32(0.0)))

    assert estimate_shutter(Stripes(times(), 0.02)).fault


@pytest.mark.parametrize("stamps", [times(0), times(1), times(20), times(60, hertz=5)])
def test_few_frames_and_large_steps_are_not_used(stamps):
    found = estimate_shutter(MovingRoom(stamps, 0.03))
    assert found.fault and found.certain_readout_s == 0.0
    assert "not determined" in str(found)


@pytest.mark.parametrize(
    ("change", "certain"),
    [
        ({}, True),
        ({"readout_sigma_s": 0.006}, False),
        ({"readout_s": 0.004}, False),
        ({"readout_s": -0.02}, False),
        ({"readout_s": 0.05}, False),
    ],
)
def test_only_certain_readouts_are_undone(change, certain):
    assert (replace(FOUND, **change).certain_readout_s > 0) == certain
    assert not ShutterEstimate().certain_readout_s


@pytest.mark.parametrize(
    ("estimate", "sigma_s"),
    [
        (FOUND, 0.001),
        (replace(FOUND, readout_sigma_s=0.006, readout_s=0.008), 0.01),
        (replace(FOUND, readout_sigma_s=0.012), 0.019),
        (ShutterEstimate(fault="too few"), 0.019),
        (ShutterEstimate(0.0, 0.0001), 0.0001),
    ],
)
def test_what_is_not_known_of_the_readout(estimate, sigma_s):
    assert estimate.remaining_sigma_s == pytest.approx(sigma_s)
