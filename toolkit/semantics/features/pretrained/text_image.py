"""Encoders with a common space for texts and images, such as CLIP and SigLIP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.semantics.features.pretrained.loading import (
    device_of,
    load_image_processor,
    load_model,
    load_tokenizer,
    weights_digest,
)

Embeddings = NDArray[np.float32]

_BATCH = 16
_DIGITS = 16  # of the digest in the name


class TextImageEncoder:
    """A model from a local folder that embeds texts and images; its weights are frozen.

    Args:
        folder: folder of a model that `AutoModel` supports, with `get_text_features` and
            `get_image_features`: CLIP, SigLIP, SigLIP 2 and others.
        device: "cpu", "cuda", or "auto".

    Attributes:
        name: architecture and digest of the weights, the same for every copy of the model.
        dimensions: length D of an embedding.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder does not contain such a model.
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        self._folder, self._device = folder, device_of(device)
        self._model = load_model("AutoModel", folder)
        config = self._model.config
        if not all(hasattr(self._model, f"get_{kind}_features") for kind in ("text", "image")):
            raise FormatError(
                f"{folder}: a {config.model_type} model does not embed texts and images; use one "
                "such as CLIP or SigLIP"
            )
        self._tokenizer = load_tokenizer(folder)
        self._processor: Any = None  # loaded for the first image
        self.name = f"{config.model_type} {weights_digest(self._model)[:_DIGITS]}"
        self._model.to(self._device)
        self._length = int(config.text_config.max_position_embeddings)
        # SigLIP was trained with texts filled up to this length, and sees the filling.
        self._filled = config.model_type.startswith("siglip")
        self.dimensions = self.embed_texts(["object"]).shape[1]

    @torch.inference_mode()
    def embed_texts(self, texts: Sequence[str]) -> Embeddings:
        """Return the embeddings [N, D] of one text or more, of unit length.

        What exceeds the maximum length of the model (77 tokens for CLIP) is cut.
        """
        return np.concatenate([self._text(text) for text in texts])

    @torch.inference_mode()
    def embed_images(self, images: Sequence[NDArray[np.uint8]]) -> Embeddings:
        """Return the embeddings [N, D] of RGB images [H, W, 3], of unit length.

        Raises:
            FormatError: the folder contains no supported image processor.
        """
        if self._processor is None:
            self._processor = load_image_processor(self._folder)
        size = getattr(self._model.config.vision_config, "image_size", None)
        found = [np.empty((0, self.dimensions), np.float32)]
        for first in range(0, len(images), _BATCH):
            batch = list(images[first : first + _BATCH])
            inputs = self._processor(
                images=batch, return_tensors="pt", input_data_format="channels_last"
            )
            pixels = inputs["pixel_values"]
            # Without its own settings, a processor has those of the most common model.
            if size is not None and pixels.ndim == 4 and tuple(pixels.shape[2:]) != (size, size):
                raise FormatError(
                    f"{self._folder}: the image processor makes images of "
                    f"{'x'.join(map(str, pixels.shape[2:]))} pixels, the model needs {size}x{size};"
                    " download preprocessor_config.json again"
                )
            found.append(self._unit(self._model.get_image_features(**inputs.to(self._device))))
        return np.concatenate(found)

    def _text(self, text: str) -> Embeddings:
        inputs = self._tokenizer(
            [text],
            padding="max_length" if self._filled else True,
            truncation=True,
            max_length=self._length,
            return_attention_mask=not self._filled,
            return_tensors="pt",
        )
        return self._unit(self._model.get_text_features(**inputs.to(self._device)))

    def _unit(self, features: Any) -> Embeddings:
        # transformers 5 returns the projected embedding as the pooled output.
        vectors = getattr(features, "pooler_output", features).float()
        if vectors.ndim != 2 or not bool(torch.isfinite(vectors).all()):
            raise FormatError(f"{self._folder}: the embeddings of the model are not finite vectors")
        return torch.nn.functional.normalize(vectors, dim=1).cpu().numpy()
