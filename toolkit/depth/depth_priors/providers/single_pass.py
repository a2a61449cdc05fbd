"""Packages that predict depth in one pass: Depth Anything 3, MoGe and VGGT.

Written for the interfaces that their repositories publish; none has run with its code or weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.options import PriorModelOptions
from toolkit.depth.depth_priors.provider import (
    Confidence,
    DepthKind,
    DepthPrior,
    DepthProvider,
    Image,
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

# Sky is more likely than not.
_SKY = 0.5
# Width of the images of VGGT, and side of its patches.
_WIDTH, _PATCH = 518, 14


class _Package:
    """A package that is not a dependency, and its weights.

    Args:
        options: `path` is the file or folder of the weights.
        name: of the package.
        licence: of the weights.

    Raises:
        DependencyError: the package cannot be imported.
        FormatError: the weights do not exist.
    """

    source: str

    def __init__(self, options: PriorModelOptions, name: str, licence: str) -> None:
        self._path = self._weights(weights_of(options))
        self._device = device_of("auto")
        self._options = options
        self.model = PriorModel(
            f"{name} {weights_of(options).name}", sha256_of(self._path), licence
        )

    def _weights(self, path: Path) -> Path:
        return path

    def _module(self, name: str) -> Any:
        return import_package(name, self._options, self.source)

    def _confidence(self, values: NDArray) -> Confidence:
        return Confidence(_array(values), self._options.min_confidence)


class DepthAnything3Depth(_Package):
    """Depth Anything 3: depth of any number of images; a folder with config.json and weights."""

    joint = True
    source = "https://github.com/ByteDance-Seed/Depth-Anything-3"

    def __init__(self, options: PriorModelOptions) -> None:
        licence = "of the checkpoint: Apache 2.0 or CC BY-NC 4.0"
        super().__init__(options, "depth-anything-3", licence)
        network = self._module("depth_anything_3.api").DepthAnything3
        self._network = network.from_pretrained(str(self._path)).to(device=self._device)

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of the frames of a set, metric if the model is, else up to one scale."""
        found = self._network.inference([image_of(frame) for frame in frames])
        priors = tuple(self._prior(frame, found, n) for n, frame in enumerate(frames))
        poses = None if found.extrinsics is None else relative_poses(found.extrinsics)
        return PriorSet(tuple(frame.index for frame in frames), priors, poses)

    def _prior(self, frame: Frame, found: Any, number: int) -> DepthPrior:
        depth = _array(found.depth[number])
        size = depth.shape[1], depth.shape[0]
        metric = bool(found.is_metric)
        return DepthPrior(
            depth,
            DepthKind.METRIC if metric else DepthKind.SCALED,
            ScaleScope.SEQUENCE if metric else ScaleScope.SET,
            self.model,
            # The default method resizes the whole image and does not crop.
            PixelMapping.resize(frame.camera.size, size),
            None if found.conf is None else self._confidence(found.conf[number]),
            None if found.sky is None else np.asarray(found.sky[number]) < _SKY,
            None if found.intrinsics is None else camera_of(found.intrinsics[number], size),
        )


class MogeDepth(_Package):
    """MoGe: depth of single images with known intrinsics; a checkpoint, or a folder of model.pt."""

    joint = False
    source = "https://github.com/microsoft/MoGe"

    def __init__(self, options: PriorModelOptions) -> None:
        super().__init__(options, "moge", "MIT")
        network = self._module("moge.model.v2").MoGeModel.from_pretrained(str(self._path))
        self._network = network.to(self._device).eval()
        self._metric = hasattr(self._network, "scale_head")

    def _weights(self, path: Path) -> Path:
        return path / "model.pt" if path.is_dir() else path

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of each frame, metric if the checkpoint has a scale, else up to one scale each."""
        return PriorSet(tuple(f.index for f in frames), tuple(self._prior(f) for f in frames))

    def _prior(self, frame: Frame) -> DepthPrior:
        image = torch.from_numpy(image_of(frame)).to(self._device).permute(2, 0, 1).float() / 255.0
        fov_x = math.degrees(2.0 * math.atan(0.5 * frame.camera.width / frame.camera.fx))
        output = self._network.infer(image, fov_x=fov_x, use_fp16=self._device.type == "cuda")
        depth = output["depth"].float().cpu().numpy()
        mask = output["mask"].cpu().numpy().astype(bool) if "mask" in output else None
        return DepthPrior(
            _array(depth),
            DepthKind.METRIC if self._metric else DepthKind.SCALED,
            ScaleScope.SEQUENCE if self._metric else ScaleScope.FRAME,
            self.model,
            PixelMapping.resize(frame.camera.size, (depth.shape[1], depth.shape[0])),
            mask=mask,
        )


class VggtDepth(_Package):
    """VGGT: depth and cameras of a set, up to one scale; a folder of huggingface_hub."""

    joint = True
    source = "https://github.com/facebookresearch/vggt"

    def __init__(self, options: PriorModelOptions) -> None:
        licence = "of the checkpoint: CC BY-NC 4.0, or VGGT-1B-Commercial's"
        super().__init__(options, "vggt", licence)
        network = self._module("vggt.models.vggt").VGGT.from_pretrained(str(self._path))
        self._poses = self._module("vggt.utils.pose_enc")
        self._network = network.to(self._device).eval()

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of the frames of a set."""
        images = torch.stack([_vggt_image(frame) for frame in frames]).to(self._device)
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
                _array(depth[n]),
                DepthKind.SCALED,
                ScaleScope.SET,
                self.model,
                _vggt_mapping(frame),
                # 1 + exp(x) of the network, without an upper limit.
                self._confidence(confidence[n]),
                camera=camera_of(intrinsics[n], (depth.shape[2], depth.shape[1])),
            )
            for n, frame in enumerate(frames)
        )
        poses = relative_poses(T_camera_world[0].float().cpu().numpy())
        return PriorSet(tuple(frame.index for frame in frames), priors, poses)


def _array(values: NDArray) -> Image:
    return np.ascontiguousarray(values, np.float32)


def _heights(frame: Frame) -> tuple[int, int]:
    """Height of the image at the width of VGGT, and of the part of it that VGGT receives."""
    width, height = frame.camera.size
    whole = max(_PATCH, round(height * _WIDTH / width / _PATCH) * _PATCH)
    return whole, min(whole, _WIDTH)


def _vggt_mapping(frame: Frame) -> PixelMapping:
    whole, used = _heights(frame)
    resize = PixelMapping.resize(frame.camera.size, (_WIDTH, whole))
    return resize.then(PixelMapping((1.0, 1.0), (0.0, -float((whole - used) // 2))))


def _vggt_image(frame: Frame) -> torch.Tensor:
    """An image [3, h, w] in [0, 1], as the package's `load_and_preprocess_images` crops it."""
    whole, used = _heights(frame)
    top = (whole - used) // 2
    image = resized(image_of(frame), (_WIDTH, whole))[top : top + used]
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255.0


SINGLE_PASS: dict[str, Callable[[PriorModelOptions], DepthProvider]] = {
    "depth-anything-3": DepthAnything3Depth,
    "moge": MogeDepth,
    "vggt": VggtDepth,
}
