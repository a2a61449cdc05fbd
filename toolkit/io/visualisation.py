"""Visualisation of images: colour-mapped depth with a scale bar, legends, captioned panels.

All images are [H, W, 3] uint8 RGB; `toolkit.io.images.write_png` saves them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.io.length_names import METRES, LengthNames

RgbImage = NDArray[np.uint8]

# Differs from every colour of the depth scale, so that holes are not mistaken for surfaces.
MISSING = (45, 45, 45)
_PAPER = (255, 255, 255)
_INK = (50, 50, 50)
# Colour map from empty (dark grey) over translucent (red to orange) to opaque (white).
_SILHOUETTE_STOPS = np.array([0.0, 0.5, 0.8, 1.0])
_SILHOUETTE_COLOURS = np.array([MISSING, (178, 58, 40), (248, 190, 130), (252, 252, 252)])

_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Pixels of a capital letter at font scale 1.
_FONT_HEIGHT = 22.0


@dataclass(frozen=True)
class DepthSpan:
    """Depth range of a colour scale; depths outside get the colour of the nearer end.

    Attributes:
        near_m, far_m: metres, 0 <= near < far.
    """

    near_m: float
    far_m: float

    def __post_init__(self) -> None:
        if not 0 <= self.near_m < self.far_m < math.inf:
            raise ValueError(f"a depth span must satisfy 0 <= near < far, got {self}")

    @classmethod
    def of(cls, depths_m: Iterable[NDArray]) -> DepthSpan:
        """Return the depth span of images, from the 1st to the 99th percentile, rounded to ticks.

        Use one span for a whole sequence to keep the colour of a surface constant.

        Args:
            depths_m: [H, W] depth images in metres, 0 or non-finite where missing. Without any
                valid depth the span is 0 to 1 m.
        """
        parts = [image[np.isfinite(image) & (image > 0)] for image in depths_m]
        values = np.concatenate(parts) if parts else np.empty(0)
        if values.size == 0:
            return cls(0.0, 1.0)
        low, high = (float(v) for v in np.percentile(values, (1, 99)))
        step = _tick_step(max(high - low, 0.05 * high))
        near_m = step * math.floor(low / step)
        return cls(near_m, max(step * math.ceil(high / step), near_m + step))


def colour_image(rgb: NDArray[np.floating]) -> RgbImage:
    """Convert RGB [H, W, 3] in [0, 1] (clamped) to an image."""
    return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


def depth_image(depth_m: NDArray[np.floating], span: DepthSpan | None = None) -> RgbImage:
    """Apply the viridis colour map to a depth image: near dark, far bright, missing dark grey.

    Args:
        depth_m: [H, W] z-depth in metres, 0 or non-finite where missing.
        span: depth range of the colour map; by default the range of this image.
    """
    span = span or DepthSpan.of([depth_m])
    valid = np.isfinite(depth_m) & (depth_m > 0)
    relative = (np.where(valid, depth_m, span.near_m) - span.near_m) / (span.far_m - span.near_m)
    image = _viridis(relative)
    image[~valid] = MISSING
    return image


def silhouette_image(silhouette: NDArray[np.floating]) -> RgbImage:
    """Colour-map accumulated opacity [H, W] in [0, 1].

    Opaque pixels are white, translucent pixels orange to red, and empty pixels dark grey.
    """
    channels = [
        np.interp(silhouette, _SILHOUETTE_STOPS, _SILHOUETTE_COLOURS[:, c]) for c in range(3)
    ]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def with_depth_scale(image: RgbImage, span: DepthSpan, names: LengthNames = METRES) -> RgbImage:
    """Append a scale bar to the right of a depth image."""
    height = image.shape[0]
    scale = _font_scale(height)
    text_height = round(_FONT_HEIGHT * scale)
    gap, bar = max(3, text_height // 2), max(6, round(text_height * 1.2))
    ticks = _ticks(span, max_count=max(2, height // (4 * text_height)))
    step = ticks[1] - ticks[0] if len(ticks) > 1 else span.far_m - span.near_m
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    labels = [f"{tick:.{decimals}f}" for tick in ticks]
    labels[-1] += f" {names.length}"
    text_width = max(_text_size(label, scale)[0] for label in labels)
    side = np.full((height, 2 * gap + bar + gap + text_width, 3), _PAPER, np.uint8)

    # Far depths at the top, as in most images; the margin leaves space for the end labels.
    margin = text_height
    length = max(height - 2 * margin, 2)
    side[margin : margin + length, gap : gap + bar] = _viridis(
        np.linspace(1.0, 0.0, length)[:, None]
    )
    for tick, label in zip(ticks, labels, strict=True):
        relative = (tick - span.near_m) / (span.far_m - span.near_m)
        y = margin + round((1.0 - relative) * (length - 1))
        side[y : y + 1, gap + bar : gap + bar + gap] = _INK
        _write(side, label, (2 * gap + bar + gap // 2, y + text_height // 2), scale)
    return np.concatenate([image, side], axis=1)


@dataclass(frozen=True)
class LegendEntry:
    """A colour (RGB, 0..255) and its label."""

    text: str
    colour: tuple[int, int, int]


def with_legend(image: RgbImage, entries: Sequence[LegendEntry], columns: int = 3) -> RgbImage:
    """Append a legend to the right of an image.

    Args:
        image: [H, W, 3].
        entries: in descending order of importance; the last line counts entries that do not fit.
        columns: maximum number of columns.
    """
    if not entries:
        return image
    height = image.shape[0]
    scale = _font_scale(height)
    rows = max(1, height // _line_height(scale))
    entries = _shortened(entries, rows * columns)
    parts = [image]
    for first in range(0, len(entries), rows):
        column = entries[first : first + rows]
        width = max(_text_size(entry.text, scale)[0] for entry in column)
        width += 4 * round(_FONT_HEIGHT * scale)  # a swatch, and a letter of margin around it
        parts.append(_legend_block(column, (height, width), scale))
    return np.concatenate(parts, axis=1)


def legend_below(image: RgbImage, entries: Sequence[LegendEntry], rows: int) -> RgbImage:
    """Append a legend of `rows` lines below an image, without changing its width."""
    height, width = image.shape[:2]
    scale = _font_scale(height)
    block = _legend_block(_shortened(entries, rows), (rows * _line_height(scale), width), scale)
    return np.concatenate([image, block], axis=0)


@dataclass(frozen=True)
class Panel:
    """One image of a strip and its caption."""

    caption: str
    image: RgbImage


def strip(panels: Sequence[Panel]) -> RgbImage:
    """Place panels of one height side by side on white, each below its caption.

    Raises:
        ValueError: there are no panels, or their heights differ.
    """
    heights = {panel.image.shape[0] for panel in panels}
    if len(heights) != 1:
        raise ValueError(f"a strip needs panels of one height, got {sorted(heights)}")
    height = heights.pop()
    scale = _font_scale(height)
    text_height = round(_FONT_HEIGHT * scale)
    gap, head = max(4, text_height // 2), 2 * text_height
    width = sum(panel.image.shape[1] for panel in panels) + gap * (len(panels) + 1)
    page = np.full((head + height + gap, width, 3), _PAPER, np.uint8)
    left = gap
    for panel in panels:
        panel_width = panel.image.shape[1]
        page[head : head + height, left : left + panel_width] = panel.image
        fitting = scale * min(1.0, panel_width / max(_text_size(panel.caption, scale)[0], 1))
        _write(page, panel.caption, (left, head - text_height // 2), fitting)
        left += panel_width + gap
    return page


def view_strip(
    rgb: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    silhouette: NDArray[np.floating],
    observed: NDArray[np.floating] | None = None,
    span: DepthSpan | None = None,
    names: LengthNames = METRES,
) -> RgbImage:
    """Show a rendered view as a strip: input (if given), render, depth, silhouette.

    Args:
        rgb: rendered colour [H, W, 3] in [0, 1].
        depth_m: rendered depth [H, W] in metres, 0 where missing.
        silhouette: [H, W] in [0, 1].
        observed: input colour image [H, W, 3].
        span: depth range of the colour map; by default the range of this view.
        names: of lengths.
    """
    span = span or DepthSpan.of([depth_m])
    panels = [] if observed is None else [Panel("input", colour_image(observed))]
    depth = with_depth_scale(depth_image(depth_m, span), span, names)
    panels += [
        Panel("render", colour_image(rgb)),
        Panel("depth", depth),
        Panel("silhouette", silhouette_image(silhouette)),
    ]
    return strip(panels)


def _viridis(values: NDArray[np.floating]) -> RgbImage:
    """Return viridis colours [H, W, 3] of values [H, W] from 0 (dark) to 1 (bright)."""
    levels = np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def _tick_step(length_m: float) -> float:
    """Return a tick spacing (1, 2 or 5 times a power of ten) with about five ticks per length."""
    power = 10.0 ** math.floor(math.log10(length_m / 5.0))
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(length_m / (m * power) - 5.0))


def _ticks(span: DepthSpan, max_count: int) -> list[float]:
    """Return the ticks of a span, at least one and about `max_count` at most."""
    step = _tick_step((span.far_m - span.near_m) * 5.0 / max(min(max_count, 6), 2))
    first, last = math.ceil(span.near_m / step - 1e-9), math.floor(span.far_m / step + 1e-9)
    return [step * i for i in range(first, last + 1)] or [span.far_m]


def _legend_block(entries: Sequence[LegendEntry], size: tuple[int, int], scale: float) -> RgbImage:
    """Draw legend entries on a block of a size (height, width); long text is scaled down."""
    block = np.full((*size, 3), _PAPER, np.uint8)
    letter, line = round(_FONT_HEIGHT * scale), _line_height(scale)
    left = 2 * letter + letter // 2
    for row, entry in enumerate(entries):
        top = row * line + (line - letter) // 2
        block[top : top + letter, letter // 2 : letter // 2 + round(1.5 * letter)] = entry.colour
        room = size[1] - left - letter // 2
        fitting = scale * min(1.0, room / max(_text_size(entry.text, scale)[0], 1))
        _write(block, entry.text, (left, top + letter), fitting)
    return block


def _shortened(entries: Sequence[LegendEntry], max_count: int) -> list[LegendEntry]:
    """Return at most `max_count` entries; if some are omitted, the last one says how many."""
    if len(entries) <= max_count:
        return list(entries)
    kept = list(entries[: max(max_count - 1, 0)])
    return [*kept, LegendEntry(f"and {len(entries) - len(kept)} more", _PAPER)][:max_count]


def _line_height(scale: float) -> int:
    return round(1.8 * _FONT_HEIGHT * scale)


def _font_scale(height: int) -> float:
    """Return the font scale for letters of about 1/25 of the image's height, 8 to 24 pixels."""
    return float(np.clip(height / 25.0, 8.0, 24.0)) / _FONT_HEIGHT


def _text_size(text: str, scale: float) -> tuple[int, int]:
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    return width, height


def _write(image: RgbImage, text: str, origin: tuple[int, int], scale: float) -> None:
    """Draw text into an image; the origin is the lower left corner of the text."""
    cv2.putText(image, text, origin, _FONT, scale, _INK, 1, cv2.LINE_AA)
