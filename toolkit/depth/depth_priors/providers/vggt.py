"""VGGT: depth and cameras of a set of images in one pass.

Written for the interface that github.com/facebookresearch/vggt publishes (`vggt.models.vggt`,
`vggt.utils.pose_enc`); it has never run with its code or weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

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
    resized,
    sha256_of,
    weights_of,
)
from toolkit.semantics.features.pretrained.loading import device_of

_SOURCE = "https://github.com/facebookresearch/vggt"
_WIDTH, _PATCH = 518, 14


class VggtDepth:
    """Depth of a set of images, up to one scale.

    Args:
        options: `path` is a folder in the format of huggingface_hub.

    Raises:
        DependencyError: the package cannot be imported.
        FormatError: the weights do not exist.
    """

    joint = True

    def __init__(self, options: PriorModelOptions) -> None:
        path = weights_of(options)
        models = import_package("vggt.models.vggt", options, _SOURCE)
        self._poses = import_package("vggt.utils.pose_enc", options, _SOURCE)
        self._device = device_of("auto")
        self._network = models.VGGT.from_pretrained(str(path)).to(self._device).eval()
        self._min_confidence = options.min_confidence
        licence = "of the checkpoint: CC BY-NC 4.0, or VGGT-1B-Commercial's"
        self.model = PriorModel(f"vggt {path.name}", sha256_of(path), licence)

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of the frames of a set."""
        images = torch.stack([_image(frame) for frame in frames]).to(self._device)
        with torch.inference_mode():
            found = self._network(images)
            T_camera_world, matrices = self._poses.pose_encoding_to_extri_intri(
                found["pose_enc"], images.shape[-2:]
            )
        depth = found["depth"][0, ..., 0].float().cpu().numpy()
        confidence = found["depth_conf"][0].float().cpu().numpy()
        intrinsics = matrices[0].float().cpu().numpy()
        priors = tuple(
            DepthPrior(
                np.ascontiguousarray(depth[n], np.float32),
                DepthKind.SCALED,
                ScaleScope.SET,
                self.model,
                _mapping(frame),
                # 1 + exp(x) of the network, without an upper limit.
                Confidence(np.ascontiguousarray(confidence[n], np.float32), self._min_confidence),
                camera=camera_of(intrinsics[n], (depth.shape[2], depth.shape[1])),
            )
            for n, frame in enumerate(frames)
        )
        poses = relative_poses(T_camera_world[0].float().cpu().numpy())
        return PriorSet(tuple(frame.index for frame in frames), priors, poses)


def _heights(frame: Frame) -> tuple[int, int]:
    """Height of the image at the model's width, and of the part of it that the model receives."""
    width, height = frame.camera.size
    whole = max(_PATCH, round(height * _WIDTH / width / _PATCH) * _PATCH)
    return whole, min(whole, _WIDTH)


def _mapping(frame: Frame) -> PixelMapping:
    whole, used = _heights(frame)
    resize = PixelMapping.resize(frame.camera.size, (_WIDTH, whole))
    return resize.then(PixelMapping((1.0, 1.0), (0.0, -float((whole - used) // 2))))


def _image(frame: Frame) -> torch.Tensor:
    """An image [3, h, w] in [0, 1], as the package's `load_and_preprocess_images` crops it."""
    whole, used = _heights(frame)
    top = (whole - used) // 2
    image = resized(image_of(frame), (_WIDTH, whole))[top : top + used]
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255.0
