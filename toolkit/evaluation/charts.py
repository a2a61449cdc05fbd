"""Line charts as inline SVG. Colours come from the CSS classes of the embedding page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 640.0, 400.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 18.0, 14.0, 44.0


@dataclass(frozen=True)
class Series:
    """A line: points [N, 2], name in the legend and CSS class."""

    points: Array
    name: str
    css_class: str


@dataclass(frozen=True)
class Axes:
    """Axis labels, reference line and marks of a chart.

    Attributes:
        x_label, y_label: labels with units.
        equal: use the same scale on both axes.
        level: y value of a dashed horizontal line and its name in the legend, or None.
        marks_x: x values of short vertical marks.
        marks_name: name of the marks in the legend.
    """

    x_label: str
    y_label: str
    equal: bool = False
    level: tuple[float, str] | None = None
    marks_x: Sequence[float] = ()
    marks_name: str = ""


@dataclass(frozen=True)
class _Window:
    """Range of the displayed values, and the mapping from values to SVG coordinates."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def x(self, value: Array | float) -> Array | float:
        fraction = (value - self.x_low) / (self.x_high - self.x_low)
        return _LEFT + fraction * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: Array | float) -> Array | float:
        fraction = (value - self.y_low) / (self.y_high - self.y_low)
        return _HEIGHT - _BOTTOM - fraction * (_HEIGHT - _BOTTOM - _TOP)


def line_chart(series: Sequence[Series], axes: Axes) -> str:
    """Return an SVG element with lines, grid and axis labels below an HTML legend.

    Non-finite points interrupt a line. Without finite points, the result is an empty string.
    """
    points = np.concatenate([np.empty((0, 2)), *(s.points for s in series)])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return ""
    window = _equal_window(points) if axes.equal else _window_from_zero(points, axes)
    body = [*_grid(window), *_labels(axes)]
    for value in axes.marks_x:
        x = window.x(value)
        body.append(f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{_TOP + 14}"/>')
    if axes.level is not None:
        y = window.y(axes.level[0])
        right = _WIDTH - _RIGHT
        body.append(f'<line class="level" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
    for item in series:
        body += _polylines(item, window)
    label = escape(f"{axes.y_label} over {axes.x_label}")
    svg = (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="{label}">'
        + "".join(body)
        + "</svg>"
    )
    return _legend(series, axes) + svg


def ticks(low: float, high: float, target_count: int = 6) -> list[float]:
    """Return tick values between low and high whose step is 1, 2 or 5 times a power of ten."""
    raw_step = (high - low) / target_count
    power = 10.0 ** math.floor(math.log10(raw_step))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw_step * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [step * index for index in range(first, last + 1)]


def _window_from_zero(points: Array, axes: Axes) -> _Window:
    """Return a window over all x values, and over y from zero to above the largest value."""
    x_low, x_high = float(points[:, 0].min()), float(points[:, 0].max())
    if x_high <= x_low:
        x_low, x_high = x_low - 0.5, x_high + 0.5
    highest = max(float(points[:, 1].max()), axes.level[0] if axes.level else 0.0)
    return _Window(x_low, x_high, 0.0, 1.12 * highest if highest > 0 else 1.0)


def _equal_window(points: Array) -> _Window:
    """Return a window centred on the points, with the aspect ratio of the chart."""
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    extent = np.maximum(points.max(axis=0) - points.min(axis=0), 1e-3)
    pixels = np.array([_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM])
    half = 1.1 * (extent / pixels).max() * pixels / 2
    return _Window(
        float(centre[0] - half[0]),
        float(centre[0] + half[0]),
        float(centre[1] - half[1]),
        float(centre[1] + half[1]),
    )


def _grid(window: _Window) -> list[str]:
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts = []
    x_ticks = ticks(window.x_low, window.x_high)
    for value, text in zip(x_ticks, _numbers(x_ticks), strict=True):
        x = window.x(value)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="tick mid" x="{x:.1f}" y="{bottom + 17}">{text}</text>')
    y_ticks = ticks(window.y_low, window.y_high, target_count=5)
    for value, text in zip(y_ticks, _numbers(y_ticks), strict=True):
        y = window.y(value)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick end" x="{_LEFT - 8}" y="{y + 4:.1f}">{text}</text>')
    return parts


def _labels(axes: Axes) -> list[str]:
    middle_x = (_LEFT + _WIDTH - _RIGHT) / 2
    middle_y = (_TOP + _HEIGHT - _BOTTOM) / 2
    return [
        f'<text class="label mid" x="{middle_x}" y="{_HEIGHT - 8}">{escape(axes.x_label)}</text>',
        f'<text class="label mid" x="0" y="0" transform="translate(14 {middle_y}) rotate(-90)">'
        f"{escape(axes.y_label)}</text>",
    ]


def _polylines(series: Series, window: _Window) -> list[str]:
    """Return the line of a series, split at non-finite points; single points become dots."""
    finite = np.isfinite(series.points).all(axis=1)
    breaks = np.flatnonzero(np.diff(finite.astype(int))) + 1
    parts = []
    segments = zip(np.split(series.points, breaks), np.split(finite, breaks), strict=True)
    for segment, is_finite in segments:
        if len(segment) == 0 or not is_finite[0]:
            continue
        pixels = np.stack([window.x(segment[:, 0]), window.y(segment[:, 1])], axis=1)
        if len(segment) == 1:
            x, y = pixels[0]
            parts.append(
                f'<circle class="{series.css_class} dot" cx="{x:.1f}" cy="{y:.1f}" r="4"/>'
            )
            continue
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        parts.append(f'<polyline class="{series.css_class}" points="{text}"/>')
    return parts


def _legend(series: Sequence[Series], axes: Axes) -> str:
    keys = [
        f'<span><i class="key {s.css_class}"></i>{escape(s.name)}</span>' for s in series if s.name
    ]
    if axes.level is not None:
        keys.append(f'<span><i class="key level"></i>{escape(axes.level[1])}</span>')
    if len(axes.marks_x):
        keys.append(f'<span><i class="key mark"></i>{escape(axes.marks_name)}</span>')
    return f'<div class="legend">{"".join(keys)}</div>' if keys else ""


def _numbers(values: Sequence[float]) -> list[str]:
    """Format tick values with the number of decimals that their step needs."""
    step = values[1] - values[0] if len(values) > 1 else 1.0
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    # Rounding may leave zero slightly negative; avoid "-0.0".
    return [f"{value if abs(value) > step / 2 else 0.0:.{digits}f}" for value in values]
