"""Depth estimation models of the `transformers` library, from local folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from toolkit.base.errors import FormatError
from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.options import PriorModelOptions
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    Image,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.depth_priors.providers.packages import sha256_of
from toolkit.io.guarded.documents import read_json
from toolkit.semantics.features.pretrained.loading import (
    check_folder,
    device_of,
    load_image_processor,
    load_model,
)

# What the output of an architecture means. For both kinds of Depth Anything, it is in the
# configuration. Depth Pro is in `_DEPTH_PRO`.
_KINDS = {
    "dpt": DepthKind.AFFINE_INVERSE,
    "zoedepth": DepthKind.METRIC,
    "glpn": DepthKind.METRIC,
}
_BY_CONFIG = ("depth_anything", "prompt_depth_anything")
_DEPTH_PRO = "depth_pro"
_SUPPORTED = ", ".join([*_BY_CONFIG, _DEPTH_PRO, *_KINDS])
_MIN_INVERSE = 1e-4


class TransformersDepth:
    """Depth of single images by `AutoModelForDepthEstimation`.

    Args:
        options: folder of the model; its licence is read from README.md, if there is one.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder is invalid, or the architecture is not supported.
    """

    joint = False

    def __init__(self, options: PriorModelOptions) -> None:
        folder = options.path
        assert folder is not None
        check_folder(folder)
        self._device = device_of("auto")
        self._network = load_model("AutoModelForDepthEstimation", folder).to(self._device)
        self._architecture = str(self._network.config.model_type)
        self._kind = _kind(self._network.config, options, folder)
        self._prepare = _preparation(self._architecture, folder)
        name = f"{self._architecture} in {folder.name}"
        self.model = PriorModel(name, sha256_of(folder), licence_of(folder))

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of each frame.

        Raises:
            FormatError: the model returns no depth.
        """
        priors = tuple(self._prior(frame) for frame in frames)
        return PriorSet(tuple(frame.index for frame in frames), priors)

    def _prior(self, frame: Frame) -> DepthPrior:
        rgb = np.rint(np.clip(frame.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
        with torch.inference_mode():
            output = self._network(self._prepare(rgb).to(self._device)).predicted_depth
        if output is None or output.ndim != 3:
            raise FormatError(f"{self.model.name} returns no depth; set another model")
        values = output[0].float().cpu().numpy()
        if self._architecture == _DEPTH_PRO:
            values = _depth_of_depth_pro(values, frame)
        height, width = values.shape
        padding = _zoedepth_padding(frame) if self._prepare.pads else (0, 0)
        padded = (frame.camera.width + 2 * padding[0], frame.camera.height + 2 * padding[1])
        pixels = PixelMapping((1.0, 1.0), (float(padding[0]), float(padding[1])))
        return DepthPrior(
            np.ascontiguousarray(values, np.float32),
            self._kind,
            ScaleScope.SEQUENCE if self._kind is DepthKind.METRIC else ScaleScope.FRAME,
            self.model,
            pixels.then(PixelMapping.resize(padded, (width, height))),
        )


class _Processor:
    """The image processor of a model."""

    def __init__(self, architecture: str, folder: Path) -> None:
        self._processor = load_image_processor(folder)
        # ZoeDepth pads by a known amount before it resizes; others are fed the whole image alone.
        self.pads = architecture == "zoedepth" and bool(getattr(self._processor, "do_pad", False))
        crops = ("do_center_crop",) if self.pads else ("do_center_crop", "do_pad")
        self._fixed = {name: False for name in crops if getattr(self._processor, name, False)}

    def __call__(self, rgb: np.ndarray) -> torch.Tensor:
        prepared: Any = self._processor(rgb, return_tensors="pt", **self._fixed)
        pixels: torch.Tensor = prepared["pixel_values"]
        return pixels


class _DepthProProcessor:
    """Resizes and normalises images for Depth Pro, whose processor needs torchvision.

    Raises:
        FormatError: preprocessor_config.json is missing or lacks a value.
    """

    pads = False

    def __init__(self, folder: Path) -> None:
        file = folder / "preprocessor_config.json"
        try:
            values = read_json(file)
            self._size = int(values["size"]["width"]), int(values["size"]["height"])
            self._mean = np.array(values["image_mean"], np.float32)
            self._std = np.array(values["image_std"], np.float32)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise FormatError(
                f"{file} is missing or lacks size, image_mean or image_std; download it again"
            ) from error

    def __call__(self, rgb: np.ndarray) -> torch.Tensor:
        image = rgb.astype(np.float32) / np.float32(255.0)
        normal = (image - self._mean) / self._std
        resized = cv2.resize(normal, self._size, interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(np.ascontiguousarray(resized.transpose(2, 0, 1)))[None]


def _preparation(architecture: str, folder: Path) -> _Processor | _DepthProProcessor:
    if architecture == _DEPTH_PRO:
        return _DepthProProcessor(folder)
    return _Processor(architecture, folder)


def _zoedepth_padding(frame: Frame) -> tuple[int, int]:
    """Columns and rows that ZoeDepth adds on each side before it resizes an image."""
    height, width = frame.camera.height, frame.camera.width
    return int(np.sqrt(width / 2) * 3), int(np.sqrt(height / 2) * 3)


def _kind(config: Any, options: PriorModelOptions, folder: Path) -> DepthKind:
    if options.values != "auto":
        return DepthKind(options.values)
    if config.model_type in _BY_CONFIG:
        metric = config.depth_estimation_type == "metric"
        return DepthKind.METRIC if metric else DepthKind.AFFINE_INVERSE
    if config.model_type == _DEPTH_PRO:
        return DepthKind.METRIC
    if config.model_type not in _KINDS:
        raise FormatError(
            f"{folder} contains a model of type {config.model_type}; supported: {_SUPPORTED}. For "
            "other types, set --depth-prior.model.values"
        )
    return _KINDS[config.model_type]


def _depth_of_depth_pro(inverse: Image, frame: Frame) -> Image:
    """Metric depth from the inverse depth of a camera whose focal length is the image's width."""
    focal = frame.camera.fx / frame.camera.width
    return np.asarray(focal / np.maximum(inverse, _MIN_INVERSE), np.float32)


def licence_of(folder: Path) -> str:
    """The licence in the header of a model card, "unknown" without one."""
    card = folder / "README.md"
    if card.is_file():
        for line in card.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("license:"):
                return line.partition(":")[2].strip() or "unknown"
    return "unknown"
