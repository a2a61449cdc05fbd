"""Keyframes' images on the device of the map, so that a step copies nothing."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from toolkit.keyframe import Keyframe, Observed

# Keyframes whose images stay on a GPU: more than one call's window, of some megabytes each.
_MOST = 32


class Observations:
    """The images of the keyframes used last; on a CPU the keyframes' own."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._held: OrderedDict[int, tuple[tuple[Tensor | None, ...], Observed]] = OrderedDict()

    def of(self, keyframe: Keyframe) -> Observed:
        """A keyframe's images."""
        if self._device.type == "cpu":
            return keyframe.images
        source = (keyframe.rgb, keyframe.depth_m, keyframe.class_ids)
        held = self._held.pop(keyframe.index, None)
        # Labels may have been overruled since, and another submap counts from 0 again.
        if held is None or any(a is not b for a, b in zip(held[0], source, strict=True)):
            held = source, keyframe.images.to(self._device)
        self._held[keyframe.index] = held
        if len(self._held) > _MOST:
            self._held.popitem(last=False)
        return held[1]
