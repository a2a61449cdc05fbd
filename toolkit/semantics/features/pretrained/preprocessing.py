"""Images as the models of `transformers` want them, from the settings beside their weights.

The processors of some models need torchvision, or files of a server; this needs neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from toolkit.base.errors import FormatError
from toolkit.io.guarded.documents import read_json

# Newer versions of transformers write all processors into the second file.
_FILES = ("preprocessor_config.json", "processor_config.json")
# Statistics of ImageNet, for models that name none.
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class ImagePreprocessing:
    """Size and colour statistics of the images of a model.

    Attributes:
        height, width: fixed size, or None.
        shortest, longest: the shorter side, and the maximum of the longer one; used without a
            fixed size. None to keep the size.
        mean, std: of the channels, for values in [0, 1].
    """

    height: int | None
    width: int | None
    shortest: int | None
    longest: int | None
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def load(cls, folder: Path) -> ImagePreprocessing:
        """Read the settings in a model's folder.

        Raises:
            FormatError: there is no such file, or a value is invalid.
        """
        file = next((folder / name for name in _FILES if (folder / name).is_file()), None)
        if file is None:
            raise FormatError(
                f"{folder} has no {_FILES[0]}, which says how images are prepared; download it too"
            )
        try:
            values = read_json(file)
            values = values.get("image_processor", values)
            size = values.get("size") or {}
            if isinstance(size, int):
                size = {"shortest_edge": size, "longest_edge": values.get("max_size")}
            mean, std = (
                tuple(float(v) for v in values.get(name, default))
                for name, default in (("image_mean", IMAGENET_MEAN), ("image_std", IMAGENET_STD))
            )
            height, width = (_length(size, name) for name in ("height", "width"))
            shortest, longest = (_length(size, f"{side}_edge") for side in ("shortest", "longest"))
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise FormatError(f"{file} cannot be read ({error}); download it again") from error
        if len(mean) != 3 or len(std) != 3 or min(std) <= 0:
            raise FormatError(f"{file}: image_mean and image_std must be three numbers each")
        if (height is None) != (width is None):
            raise FormatError(f"{file}: size needs both height and width; download it again")
        return cls(height, width, shortest, longest, mean, std)

    def size_of(self, height: int, width: int) -> tuple[int, int]:
        """Height and width to which an image is scaled."""
        if self.height is not None and self.width is not None:
            return self.height, self.width
        if self.shortest is None:
            return height, width
        scale = self.shortest / min(height, width)
        if self.longest is not None:
            scale = min(scale, self.longest / max(height, width))
        return max(1, round(scale * height)), max(1, round(scale * width))

    def prepared(self, rgb: Tensor, size: tuple[int, int] | None = None) -> Tensor:
        """Return the input [1, 3, h, w] of a model from an image [3, H, W] of 8 bits.

        Args:
            size: height and width, by default `size_of`.
        """
        size = size or self.size_of(*rgb.shape[1:])
        image = torch.nn.functional.interpolate(
            rgb[None].float() / 255.0, size, mode="bilinear", align_corners=False, antialias=True
        )
        mean, std = (image.new_tensor(values).view(1, 3, 1, 1) for values in (self.mean, self.std))
        return (image - mean) / std


def _length(size: dict[str, Any], name: str) -> int | None:
    length = size.get(name)
    if length is None:
        return None
    if int(length) < 1:
        raise ValueError(f"size.{name} is {length}")
    return int(length)
