"""Depth Anything 3: depth and poses of any number of images.

Written for the interface that github.com/ByteDance-Seed/Depth-Anything-3 publishes
(`depth_anything_3.api`); it has never run with its code or weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.options import PriorModelOptions
from toolkit.depth.depth_priors.provider import (
    Confidence,
    DepthKind,
    DepthPrior,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.depth_priors.providers.packages import (
    camera_of,
    image_of,
    import_package,
    relative_poses,
    sha256_of,
    weights_of,
)
from toolkit.semantics.features.pretrained.loading import device_of

_SOURCE = "https://github.com/ByteDance-Seed/Depth-Anything-3"
# Sky is more likely than not.
_SKY = 0.5


class DepthAnything3Depth:
    """Depth of a set of images.

    Args:
        options: `path` is a folder with config.json and model.safetensors.

    Raises:
        DependencyError: the package cannot be imported.
        FormatError: the weights do not exist.
    """

    joint = True

    def __init__(self, options: PriorModelOptions) -> None:
        path = weights_of(options)
        package = import_package("depth_anything_3.api", options, _SOURCE)
        network = package.DepthAnything3.from_pretrained(str(path))
        self._network = network.to(device=device_of("auto"))
        self._min_confidence = options.min_confidence
        licence = "of the checkpoint: Apache 2.0 or CC BY-NC 4.0"
        self.model = PriorModel(f"depth-anything-3 {path.name}", sha256_of(path), licence)

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of the frames of a set, metric if the model is, else up to one scale."""
        found = self._network.inference([image_of(frame) for frame in frames])
        priors = tuple(self._prior(frame, found, n) for n, frame in enumerate(frames))
        poses = None if found.extrinsics is None else relative_poses(found.extrinsics)
        return PriorSet(tuple(frame.index for frame in frames), priors, poses)

    def _prior(self, frame: Frame, found: Any, number: int) -> DepthPrior:
        depth = np.ascontiguousarray(found.depth[number], np.float32)
        size = depth.shape[1], depth.shape[0]
        metric = bool(found.is_metric)
        confidence = None
        if found.conf is not None:
            values = np.ascontiguousarray(found.conf[number], np.float32)
            confidence = Confidence(values, self._min_confidence)
        return DepthPrior(
            depth,
            DepthKind.METRIC if metric else DepthKind.SCALED,
            ScaleScope.SEQUENCE if metric else ScaleScope.SET,
            self.model,
            # The default method resizes the whole image and does not crop.
            PixelMapping.resize(frame.camera.size, size),
            confidence,
            None if found.sky is None else np.asarray(found.sky[number]) < _SKY,
            None if found.intrinsics is None else camera_of(found.intrinsics[number], size),
        )
