"""MoGe: depth of single images, with known intrinsics.

Written for the interface that github.com/microsoft/MoGe publishes (`moge.model.v2`); it has never
run with its code or weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.options import PriorModelOptions
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.depth_priors.providers.packages import (
    image_of,
    import_package,
    sha256_of,
    weights_of,
)
from toolkit.semantics.features.pretrained.loading import device_of

_SOURCE = "https://github.com/microsoft/MoGe"
_FILE = "model.pt"


class MogeDepth:
    """Depth of single images; metric if the checkpoint has a scale, else up to one scale each.

    Args:
        options: `path` is a checkpoint of version 2, or the folder of its model.pt.

    Raises:
        DependencyError: the package cannot be imported.
        FormatError: the weights do not exist.
    """

    joint = False

    def __init__(self, options: PriorModelOptions) -> None:
        path = weights_of(options)
        file = path / _FILE if path.is_dir() else path
        package = import_package("moge.model.v2", options, _SOURCE)
        self._device = device_of("auto")
        self._network = package.MoGeModel.from_pretrained(str(file)).to(self._device).eval()
        self._metric = hasattr(self._network, "scale_head")
        self.model = PriorModel(f"moge {path.name}", sha256_of(file), "MIT")

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of each frame."""
        return PriorSet(tuple(f.index for f in frames), tuple(self._prior(f) for f in frames))

    def _prior(self, frame: Frame) -> DepthPrior:
        image = torch.from_numpy(image_of(frame)).to(self._device).permute(2, 0, 1).float() / 255.0
        fov_x = math.degrees(2.0 * math.atan(0.5 * frame.camera.width / frame.camera.fx))
        output = self._network.infer(image, fov_x=fov_x, use_fp16=self._device.type == "cuda")
        depth = output["depth"].float().cpu().numpy()
        mask = output["mask"].cpu().numpy().astype(bool) if "mask" in output else None
        return DepthPrior(
            np.ascontiguousarray(depth, np.float32),
            DepthKind.METRIC if self._metric else DepthKind.SCALED,
            ScaleScope.SEQUENCE if self._metric else ScaleScope.FRAME,
            self.model,
            PixelMapping.resize(frame.camera.size, (depth.shape[1], depth.shape[0])),
            mask=mask,
        )
