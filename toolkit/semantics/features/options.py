"""Options of image descriptors for place recognition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class FeatureOptions:
    """Image descriptors for place recognition."""

    kind: Literal["vlad", "builtin", "dinov2", "colour-histogram"] = "vlad"
    """Encoder of images: aggregated SIFT keypoints (vlad), edges and colours of the whole image
    without learned weights (builtin), DINOv2 or another vision transformer in the format of
    transformers (dinov2), or a baseline
    (colour-histogram)."""
    source: Literal["rgb", "semantic", "both"] = "rgb"
    """Image to encode: colour (rgb), classes in their colours as in GauSem-SLAM (semantic) or
    both."""
    folder: Path | None = None
    """Local folder of the vision transformer with config.json and the weights; required for
    dinov2."""
