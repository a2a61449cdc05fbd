"""Options of image descriptors for place recognition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from toolkit.options import Range


@dataclass(frozen=True)
class Dinov2Options:
    """The DINOv2 encoder, or another vision transformer in the format of transformers."""

    folder: Path | None = None
    """Local folder with config.json and the weights; required for this encoder."""
    pooling: Literal["class", "mean"] = "class"
    """Token used as the descriptor: the class token (class) or the mean of all patches (mean)."""
    longest_side: Annotated[int, Range(ge=14)] = 224
    """Length in pixels to which the longer side of an image is resized."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device that computes the descriptors."""


@dataclass(frozen=True)
class FeatureOptions:
    """Image descriptors for place recognition."""

    kind: Literal["vlad", "builtin", "dinov2", "colour-histogram"] = "vlad"
    """Encoder of images: aggregated SIFT keypoints (vlad), edges and colours of the whole image
    without learned weights (builtin), a vision transformer (dinov2) or a baseline
    (colour-histogram)."""
    source: Literal["rgb", "semantic", "both"] = "rgb"
    """Image to encode: colour (rgb), classes in their colours as in GauSem-SLAM (semantic) or
    both."""
    dinov2: Dinov2Options = Dinov2Options()
