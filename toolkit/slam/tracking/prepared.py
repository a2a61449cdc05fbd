"""Preprocessing of frames for alignment, in another thread while earlier frames are tracked."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

import numpy as np
import torch

from toolkit.base.frame import Frame
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import finest_level, limited_to_width, pyramid

# Maximum number of cached frames.
_MAX_FRAMES = 8
# The median depth is computed from every n-th pixel in each direction. With all pixels it would
# take as long as rendering the map.
_STRIDE = 4
# Images with fewer pixels are not halved: at 300x170, views that are 16 frames of office0 apart are
# no longer found, which they are at 600x340.
MIN_PIXELS = 320 * 240


@dataclass(frozen=True)
class PreparedFrame:
    """A frame with the data that alignment needs and that does not depend on the map.

    Attributes:
        frame: the original frame.
        levels: image pyramid from fine to coarse, on the map's device.
        median_depth_m: median depth in metres; 1 without depth.
        measured: number of pixels with depth at the finest level.
    """

    frame: Frame
    levels: list[FrameLevel]
    median_depth_m: float
    measured: int


def prepared(
    frame: Frame, levels: int, device: torch.device, max_width: int | None = None
) -> PreparedFrame:
    """Preprocess a frame.

    Args:
        levels: number of pyramid levels.
        max_width: of the finest level in pixels; wider images are halved, unless fewer than
            `MIN_PIXELS` pixels would remain. None for any width.
    """
    finest = finest_level(frame, device)
    if max_width is not None:
        finest = limited_to_width(finest, max_width, MIN_PIXELS)
    sparse = frame.depth_m[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    valid = sparse[sparse > 0]
    return PreparedFrame(
        frame,
        pyramid(finest, levels),
        float(np.median(valid)) if valid.size else 1.0,
        int((finest.depth_m > 0).sum()),
    )


class PreparedFrames:
    """Thread-safe cache of preprocessed frames.

    Args:
        levels: number of pyramid levels.
        max_width: of the finest level in pixels; wider images are halved.
    """

    def __init__(self, levels: int, max_width: int | None = None) -> None:
        self._levels, self._max_width = levels, max_width
        self._cache: list[PreparedFrame] = []
        self._lock = threading.Lock()

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Preprocess a frame that will be tracked soon, and cache the result."""
        self._prepared(frame, device)

    def of(self, frame: Frame, device: torch.device) -> PreparedFrame:
        """The preprocessed frame, from the cache or computed now; earlier frames are removed."""
        with self._lock:
            self._cache = [p for p in self._cache if p.frame.index >= frame.index]
            cached = list(self._cache)
        for p in cached:
            same = p.frame.rgb is frame.rgb and p.frame.depth_m is frame.depth_m
            if same and p.levels[0].depth_m.device == device:
                # Labels may have been added since.
                return p if p.frame is frame else replace(p, frame=frame)
        return self._prepared(frame, device)

    def _prepared(self, frame: Frame, device: torch.device) -> PreparedFrame:
        new = prepared(frame, self._levels, device, self._max_width)
        with self._lock:
            self._cache = [*self._cache, new][-_MAX_FRAMES:]
        return new
