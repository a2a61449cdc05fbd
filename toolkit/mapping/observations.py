"""Cache of keyframe images on the device of the map, so that they are not copied in each step."""

from __future__ import annotations

import torch

from toolkit.caching import LruCache
from toolkit.keyframe import Keyframe, Observed

# Maximum number of keyframes in the cache: more than a mapping window, a few megabytes each.
_MAX_KEYFRAMES = 32


class KeyframeImages:
    """LRU cache of keyframe images; on a CPU it returns the keyframes' own images."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._cache: LruCache[Observed] = LruCache(_MAX_KEYFRAMES)

    def of(self, keyframe: Keyframe) -> Observed:
        """The images of a keyframe on the map's device."""
        if self._device.type == "cpu":
            return keyframe.images
        # Labels may have been corrected, and keyframes of other submaps may have the same index.
        sources = (keyframe.rgb, keyframe.depth_m, keyframe.class_ids)
        return self._cache.get(keyframe.index, lambda: keyframe.images.to(self._device), sources)
