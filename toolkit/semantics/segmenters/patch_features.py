"""Features of an image's patches from a vision transformer, DINOv2 above all."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.semantics.segmenters.pretrained import device_of, load_model

# Of ImageNet, for models that bring no preprocessor_config.json.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class PatchEncoder:
    """One feature vector for each patch of an image.

    Args:
        folder: a local folder with a vision transformer that `AutoModel` reads.
        longest_side: images are scaled to about so many pixels, whole patches; small ones are
            enlarged, for finer features.
        device: "cpu", "cuda", or "auto".

    Attributes:
        channels: length D of a feature vector.
        longest_side: as given.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not there.
        FormatError: the folder is not what it should be, or the model has no patches.
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
                f"{folder}: a {config.model_type} model has no patches of one size; give a "
                "vision transformer such as DINOv2"
            )
        self.channels = channels
        self.longest_side, self._patch = longest_side, patch
        self._mean, self._std = _normalisation(folder)
        # Models made for one size stretch their positions only if told so.
        parameters = inspect.signature(self._model.forward).parameters
        self._options = (
            {"interpolate_pos_encoding": True} if "interpolate_pos_encoding" in parameters else {}
        )

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the weights: a head fits the encoder it was trained on, and no other."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self._model.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()

    def features(self, rgb: NDArray[np.float32]) -> torch.Tensor:
        """Features [rows, columns, D] float32 of the patches of an image.

        Args:
            rgb: [H, W, 3] in [0, 1]; it is scaled as a whole, so that patches cover all of it.
        """
        height, width = rgb.shape[:2]
        scale = self.longest_side / max(height, width)
        rows, columns = (max(1, round(n * scale / self._patch)) for n in (height, width))
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device)
        image = image.permute(2, 0, 1)[None]
        size = (rows * self._patch, columns * self._patch)
        image = torch.nn.functional.interpolate(
            image, size=size, mode="bilinear", align_corners=False, antialias=True
        )
        image = (image - image.new_tensor(self._mean).view(1, 3, 1, 1)) / image.new_tensor(
            self._std
        ).view(1, 3, 1, 1)
        with torch.no_grad():
            tokens = self._model(image, **self._options).last_hidden_state[0]
        if tokens.ndim != 2 or tokens.shape[0] < rows * columns:
            raise FormatError(
                f"the encoder gave {list(tokens.shape)} for {rows}x{columns} patches; give a "
                "vision transformer such as DINOv2"
            )
        # Class and register tokens come first.
        return tokens[-rows * columns :].reshape(rows, columns, -1).float()


def _normalisation(folder: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and deviation of colour that the model was trained with."""
    file = folder / "preprocessor_config.json"
    if not file.is_file():
        return _MEAN, _STD
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        mean, std = values.get("image_mean", _MEAN), values.get("image_std", _STD)
        mean, std = tuple(float(v) for v in mean), tuple(float(v) for v in std)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise FormatError(f"{file} cannot be read ({error}); download it again") from error
    if len(mean) != 3 or len(std) != 3 or min(std) <= 0:
        raise FormatError(f"{file}: image_mean and image_std must be three numbers each")
    return mean, std
