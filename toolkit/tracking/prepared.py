"""Frames made ready for alignment, by another thread while those before them are tracked."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch

from toolkit.alignment.data import FrameLevel
from toolkit.alignment.levels import finest_level, pyramid
from toolkit.frame import Frame

# Frames held at most; each that is asked for lets go of all before it.
_MOST = 8
# The median depth is told by every n-th pixel in each direction: over all of them it takes as
# long as drawing the map does.
_STRIDE = 4


@dataclass(frozen=True)
class PreparedFrame:
    """What alignment asks of a frame, whatever the map.

    Attributes:
        levels: fine to coarse, on the map's device.
        reach_m: median depth, 1 where none was measured.
        measured: pixels with depth.
    """

    frame: Frame
    levels: list[FrameLevel]
    reach_m: float
    measured: int


def prepared(frame: Frame, levels: int, device: torch.device) -> PreparedFrame:
    """A frame made ready."""
    sparse = frame.depth_m[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    valid = sparse[sparse > 0]
    return PreparedFrame(
        frame,
        pyramid(finest_level(frame, device), levels),
        float(np.median(valid)) if valid.size else 1.0,
        int((frame.depth_m > 0).sum()),
    )


class FramesAhead:
    """Holds what was prepared until it is asked for; two threads may use it."""

    def __init__(self, levels: int) -> None:
        self._levels = levels
        self._held: list[PreparedFrame] = []
        self._lock = threading.Lock()

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Make a frame ready that will be asked for soon."""
        made = prepared(frame, self._levels, device)
        with self._lock:
            self._held = [*self._held, made][-_MOST:]

    def of(self, frame: Frame, device: torch.device) -> PreparedFrame:
        """A frame made ready, before or now; labels may have been added to it since."""
        with self._lock:
            self._held = [p for p in self._held if p.frame.index >= frame.index]
            held = list(self._held)
        for p in held:
            same = p.frame.rgb is frame.rgb and p.frame.depth_m is frame.depth_m
            if same and p.levels[0].depth_m.device == device:
                return p
        return prepared(frame, self._levels, device)
