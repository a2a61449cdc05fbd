"""Readout time and delay of depth of a recording, with their standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame
from toolkit.datasets.jackknife import jackknife_sigmas
from toolkit.datasets.prefetch import read_ahead
from toolkit.datasets.shutter.alignment import ShutterTimes, TimeEquations
from toolkit.datasets.shutter.windows import MIN_FRAMES, ShutterWindow

Array = NDArray[np.float64]

_WINDOW = 12
_MAX_WINDOWS = 16
# With fewer windows, their spread does not give a standard deviation.
_MIN_WINDOWS = 4
# Frames that are farther apart (seconds) do not give the velocity of a hand.
_MAX_PERIOD_S = 0.1
# Intervals of a window that differ more from their median contain dropped frames.
_MAX_IRREGULARITY = 0.25
_ROUNDS = 3
# Deviation of single pairs in seconds, from all but the velocities, whose errors change the
# readout in proportion; a readout near 0 may still be wrong by errors relative to this one.
_PAIR_SIGMA_S = 0.002
_LEAST_READOUT_S = 0.01
# Median of chi-square with two degrees of freedom.
_MEDIAN_CHI_SQUARE = 1.386
# Pairs of this chi-square have half the weight.
_HALF_WEIGHT = 8.0
# A readout is undone if it is that many standard deviations long, and has an effect.
_CERTAIN = 4.0
_MIN_READOUT_S = 0.005
# Root mean square of readouts between 0 and 33 ms.
_UNKNOWN_READOUT_S = 0.019


class TimedFrames(Protocol):
    """A sequence of frames with known times [N] in seconds."""

    @property
    def timestamps_s(self) -> Array: ...

    def __getitem__(self, index: int) -> Frame: ...


@dataclass(frozen=True)
class ShutterEstimate:
    """Estimated times of the shutter.

    Attributes:
        readout_s: seconds from the exposure of the first row to that of the last.
        readout_sigma_s: its standard deviation; infinite if it is not determined.
        delay_s: seconds from the exposure of colour to that of depth.
        delay_sigma_s: its standard deviation; infinite if it is not determined.
        period_s: median time between frames.
        fault: why the times are not determined; empty if they are.
    """

    readout_s: float = 0.0
    readout_sigma_s: float = float("inf")
    delay_s: float = 0.0
    delay_sigma_s: float = float("inf")
    period_s: float = 0.0
    fault: str = ""

    @property
    def certain_readout_s(self) -> float:
        """The readout time if it is certain, otherwise 0."""
        certain = _CERTAIN * self.readout_sigma_s <= self.readout_s
        # A sensor starts its next image after the last row; a longer readout follows from wrong
        # times of the frames.
        possible = _MIN_READOUT_S <= self.readout_s <= self.period_s
        return self.readout_s if certain and possible else 0.0

    @property
    def remaining_sigma_s(self) -> float:
        """Standard deviation of the readout time from `certain_readout_s`."""
        if self.fault:
            return _UNKNOWN_READOUT_S
        undone = self.certain_readout_s
        return min(
            float(np.hypot(self.readout_sigma_s, self.readout_s - undone)), _UNKNOWN_READOUT_S
        )

    def __str__(self) -> str:
        if self.fault:
            return f"not determined ({self.fault})"
        return (
            f"readout {1e3 * self.readout_s:.1f} ms (standard deviation "
            f"{1e3 * self.readout_sigma_s:.1f}), depth {1e3 * abs(self.delay_s):.1f} ms "
            f"{'after' if self.delay_s >= 0 else 'before'} colour "
            f"({1e3 * self.delay_sigma_s:.1f})"
        )


def estimate_shutter(frames: TimedFrames) -> ShutterEstimate:
    """Estimate the readout time and the delay of depth from a recording.

    Args:
        frames: with depth; about 160 pixels wide. At most `_MAX_WINDOWS` short windows, spread
            over the sequence, are read.
    """
    times_s = frames.timestamps_s
    period_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    starts = _window_starts(times_s)
    if len(starts) < _MIN_WINDOWS:
        return ShutterEstimate(
            period_s=period_s,
            fault=f"there are fewer than {_MIN_WINDOWS} windows of {_WINDOW} frames in regular "
            f"intervals of at most {_MAX_PERIOD_S:g} s",
        )
    windows = _windows(frames, starts)
    times = np.zeros(2)
    for number in range(_ROUNDS):
        found = [w.equations(ShutterTimes.of(times), coarse=number == 0) for w in windows]
        groups = [equations for equations in found if equations]
        if len(groups) < _MIN_WINDOWS:
            return ShutterEstimate(
                period_s=period_s,
                fault=f"frames can be aligned in {len(groups)} of {len(starts)} windows",
            )
        correction, sigmas = _combined(groups, ShutterTimes.of(times))
        times = times + correction
    return ShutterEstimate(
        float(times[0]), float(sigmas[0]), float(times[1]), float(sigmas[1]), period_s
    )


def _window_starts(times_s: Array) -> list[int]:
    """First frames of windows in regular intervals, spread over the sequence."""
    intervals = np.diff(times_s)
    last = len(times_s) - _WINDOW
    if last < 0:
        return []
    period_s = float(np.median(intervals))
    regular = np.abs(intervals - period_s) <= _MAX_IRREGULARITY * period_s
    count = min(_MAX_WINDOWS, len(times_s) // _WINDOW)
    starts: list[int] = []
    for wanted in np.linspace(0, last, count).astype(int):
        # A window with dropped frames is moved to the next regular interval.
        for start in range(max(wanted, starts[-1] + _WINDOW if starts else 0), last + 1):
            if regular[start : start + _WINDOW - 1].all():
                starts.append(start)
                break
    return starts if period_s <= _MAX_PERIOD_S else []


def _windows(frames: TimedFrames, starts: Sequence[int]) -> list[ShutterWindow]:
    """The windows from some frames on that can be read and aligned."""
    # A window is read while the one before is aligned.
    read = read_ahead(lambda start: _readable(frames, start), starts, ahead=1)
    found = [ShutterWindow.of(own) for own in read if len(own) >= MIN_FRAMES]
    return [window for window in found if window is not None]


def _readable(frames: TimedFrames, start: int) -> list[Frame]:
    """The frames of a window, without repeated images, whose times are unknown."""
    read: list[Frame] = []
    longest: list[Frame] = []
    for index in range(start, start + _WINDOW):
        try:
            frame = frames[index]
        except ToolkitError:
            return []  # the file is named when the frame is processed
        if read and _repeats(read[-1], frame):
            read = []
        read.append(frame)
        longest = max(longest, read, key=len)
    return longest


def _repeats(before: Frame, frame: Frame) -> bool:
    """Whether a frame contains an image of the frame before it again."""
    return np.array_equal(before.depth_m, frame.depth_m) or np.array_equal(before.rgb, frame.rgb)


def _combined(
    groups: Sequence[Sequence[TimeEquations]], known: ShutterTimes
) -> tuple[Array, Array]:
    """Correction [2] of the times from groups of equations, and its standard deviations [2].

    Residuals of neighbouring pixels are not independent, and neither are pairs of one window. The
    equations are scaled by their spread, and the standard deviations are those of the jackknife
    over windows.
    """
    H = np.array([e.H for group in groups for e in group])
    g = np.array([e.g for group in groups for e in group])
    window = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    errors = np.array([e.velocity_error for group in groups for e in group])
    sigmas_s = np.hypot(_PAIR_SIGMA_S, max(known.readout_s, _LEAST_READOUT_S) * errors)
    variance = sigmas_s[:, None, None] ** 2
    scale, weights, times = 1.0, np.ones(len(H)), np.zeros(2)
    for _ in range(20):
        shrunk = np.linalg.inv(np.eye(2) + variance / scale * H)
        information, wanted = shrunk @ H / scale, -(shrunk @ g[..., None])[..., 0] / scale
        times = _solved(information, wanted, weights)
        # With P = H / scale: r' (P + sigma^2 P P)^-1 r
        r = (g + H @ times) / scale
        spread = H / scale + variance / scale**2 * H @ H
        chi_square = (r * np.linalg.solve(spread, r[..., None])[..., 0]).sum(axis=1)
        weights = 1.0 / (1.0 + chi_square / _HALF_WEIGHT)
        scale = max(1.0, scale * float(np.median(chi_square)) / _MEDIAN_CHI_SQUARE)
    without = np.array(
        [_solved(information, wanted, weights * (window != n)) for n in range(len(groups))]
    )
    return times, jackknife_sigmas(without)


def _solved(information: Array, wanted: Array, weights: Array) -> Array:
    total = (weights[:, None, None] * information).sum(axis=0)
    return np.asarray(np.linalg.solve(total, (weights[:, None] * wanted).sum(axis=0)))
