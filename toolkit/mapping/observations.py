"""Cache of keyframe images on the device of the map, so that they are not copied in each step."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from toolkit.keyframe import Keyframe, Observed

# Maximum number of keyframes in the cache: more than a mapping window, a few megabytes each.
_MAX_KEYFRAMES = 32


class Observations:
    """LRU cache of keyframe images; on a CPU it returns the keyframes' own images."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._cache: OrderedDict[int, tuple[tuple[Tensor | None, ...], Observed]] = OrderedDict()

    def of(self, keyframe: Keyframe) -> Observed:
        """The images of a keyframe on the map's device."""
        if self._device.type == "cpu":
            return keyframe.images
        source = (keyframe.rgb, keyframe.depth_m, keyframe.class_ids)
        cached = self._cache.pop(keyframe.index, None)
        # Labels may have been corrected, and keyframes of other submaps may have the same index.
        if cached is None or any(a is not b for a, b in zip(cached[0], source, strict=True)):
            cached = source, keyframe.images.to(self._device)
        self._cache[keyframe.index] = cached
        if len(self._cache) > _MAX_KEYFRAMES:
            self._cache.popitem(last=False)
        return cached[1]
