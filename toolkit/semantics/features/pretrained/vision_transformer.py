"""Vision transformers such as DINOv2: tokens of image patches."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from toolkit.base.errors import FormatError
from toolkit.semantics.features.pretrained.loading import device_of, load_model, weights_digest
from toolkit.semantics.features.pretrained.preprocessing import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ImagePreprocessing,
)


@dataclass(frozen=True)
class PatchTokens:
    """Tokens of a batch of images.

    Attributes:
        class_token: [B, D] float32, the class token, or None if the model has none.
        patches: [B, rows, columns, D] float32.
    """

    class_token: Tensor | None
    patches: Tensor


class VisionTransformer:
    """A model from a local folder with frozen weights.

    Args:
        folder: folder of a vision transformer that `AutoModel` supports.
        longest_side: approximate length in pixels to which the longer image side is scaled, a
            multiple of the patch size; small images are enlarged for finer features.
        device: "cpu", "cuda", or "auto".

    Attributes:
        channels: token dimension D.
        longest_side: see the argument.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder does not contain a supported model.
    """

    def __init__(self, folder: Path, longest_side: int = 518, device: str = "auto") -> None:
        self._device = device_of(device)
        # Only classification uses the pooler.
        self._model = load_model("AutoModel", folder, may_be_new=("pooler.",))
        self._model.to(self._device)
        config = self._model.config
        patch, channels = getattr(config, "patch_size", None), getattr(config, "hidden_size", None)
        if not isinstance(patch, int) or not isinstance(channels, int):
            raise FormatError(
                f"{folder}: a {config.model_type} model has no fixed patch size; use a vision "
                "transformer such as DINOv2"
            )
        self.channels = channels
        self.longest_side, self._patch = longest_side, patch
        self._mean, self._std = _normalisation(folder)
        # Models trained at a fixed size need this option to interpolate position embeddings.
        parameters = inspect.signature(self._model.forward).parameters
        self._options = (
            {"interpolate_pos_encoding": True} if "interpolate_pos_encoding" in parameters else {}
        )

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the weights, to detect heads that were trained on another model's tokens."""
        return weights_digest(self._model)

    def tokens(self, images: Tensor) -> PatchTokens:
        """Compute tokens of images on the model's device, differentiable in the images.

        Args:
            images: [B, 3, H, W] float32, RGB in [0, 1]; they are scaled to a multiple of the patch
                size without cropping.
        """
        images = images.to(self._device)
        height, width = images.shape[2:]
        scale = self.longest_side / max(height, width)
        rows, columns = (max(1, round(n * scale / self._patch)) for n in (height, width))
        images = torch.nn.functional.interpolate(
            images,
            size=(rows * self._patch, columns * self._patch),
            mode="bilinear",
            align_corners=False,
            antialias=True,
        )
        mean, std = (images.new_tensor(v).view(1, 3, 1, 1) for v in (self._mean, self._std))
        tokens = self._model((images - mean) / std, **self._options).last_hidden_state
        if tokens.ndim != 3 or tokens.shape[1] < rows * columns:
            raise FormatError(
                f"the encoder returned {list(tokens.shape[1:])} for {rows}x{columns} patches; use "
                "a vision transformer such as DINOv2"
            )
        # Class and register tokens come first.
        extra = tokens.shape[1] - rows * columns
        patches = tokens[:, extra:].unflatten(1, (rows, columns)).float()
        return PatchTokens(tokens[:, 0].float() if extra else None, patches)


def _normalisation(folder: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read the colour mean and standard deviation of the model's preprocessing."""
    if not (folder / "preprocessor_config.json").is_file():
        return IMAGENET_MEAN, IMAGENET_STD
    found = ImagePreprocessing.load(folder)
    return found.mean, found.std
