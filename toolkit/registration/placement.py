"""Where a keyframe stands, by what the keyframes before it observed.

A tracker aligns frames to the map, and a map has errors that images have not: its surfaces are
drawn by overlapping Gaussians, and what was seen a moment ago is not yet fitted. So a new
keyframe is aligned once more, to the images and depth of earlier keyframes, all of them
together; the tracker's pose is where that begins. On a rendered walk with a sensor's noise
paths through one submap become five to ten times as exact.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import FrameLevel, ModelLevel
from toolkit.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.alignment.levels import limited_to_width, model_level, pyramid
from toolkit.exposure import Exposure
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe
from toolkit.registration.matching import parted
from toolkit.registration.views import observed_level

Array = NDArray[np.float64]

# Keyframes whose pyramids are held: to make one takes as long as to align it.
_HELD = 12


@dataclass(frozen=True)
class PlacementOptions:
    """Values of the placement.

    Attributes:
        recent: newest keyframes that are compared.
        older: most others, spread from the oldest on: they hold the path together.
        every: only each n-th keyframe is one of these, so that they stay the same for a while.
        least_recent, least_older: share of the new keyframe's points that either has to show.
        largest_width: images are halved until they are no wider. 320 as 160 pixels take two
            fifths of the time, and cost 0.1 mm on a ring of rooms, a quarter of a decibel of
            mapped views on fr1_rpy.
        dense: of the alignment; a tracked pose is good to a pixel or two, so few levels do.
    """

    recent: int = 2
    older: int = 4
    every: int = 4
    least_recent: float = 0.2
    least_older: float = 0.5
    largest_width: int = 400
    dense: JointOptions = field(default_factory=lambda: JointOptions(levels=2))


@dataclass(frozen=True)
class _Levels:
    """A keyframe's pyramid, as what is aligned to and as what is aligned."""

    model: list[ModelLevel]
    frame: list[FrameLevel]


class KeyframePlacement:
    """Places keyframes; it remembers the pyramids of those it compared last."""

    def __init__(self, options: PlacementOptions | None = None) -> None:
        self.options = options or PlacementOptions()
        self._held: OrderedDict[tuple[int, Exposure], _Levels] = OrderedDict()

    def place(self, keyframes: Sequence[Keyframe], new: Keyframe) -> Array:
        """T_map_camera [4, 4] of a new keyframe; its own where earlier ones do not fix it.

        Args:
            keyframes: of the same map, in order; their poses stay.
            new: at the pose that the tracker gave.
        """
        chosen = self._chosen(keyframes, new)
        if not chosen:
            return new.T_map_camera
        frame = self._levels(new).frame
        pairs = [
            Pair(self._levels(k).model, frame, se3.inverse(k.T_map_camera), np.eye(4))
            for k in chosen
        ]
        found = align(pairs, Estimate(new.T_map_camera), self.options.dense)
        moved = se3.inverse(new.T_map_camera) @ found.T_target_source
        if not found.converged or parted(np.eye(4), moved, new.camera, new):
            return new.T_map_camera
        return found.T_target_source

    def _chosen(self, keyframes: Sequence[Keyframe], new: Keyframe) -> list[Keyframe]:
        """Earlier keyframes that show what the new one does, in order."""
        options, points = self.options, new.points_in_map()
        first_recent = max(len(keyframes) - options.recent, 0)
        recent = [
            k for k in keyframes[first_recent:] if k.share_observed(points) >= options.least_recent
        ]
        older = [
            k
            for k in keyframes[: first_recent : options.every]
            if k.share_observed(points) >= options.least_older
        ]
        if len(older) > options.older:
            spread = np.linspace(0, len(older) - 1, options.older).round().astype(int)
            older = [older[place] for place in spread]
        return [*older, *recent]

    def _levels(self, keyframe: Keyframe) -> _Levels:
        key = (keyframe.index, keyframe.exposure)
        if key not in self._held:
            finest = limited_to_width(observed_level(keyframe), self.options.largest_width)
            frame = pyramid(finest, self.options.dense.levels)
            self._held[key] = _Levels([model_level(level) for level in frame], frame)
            while len(self._held) > _HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(key)
        return self._held[key]
