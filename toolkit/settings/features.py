"""Settings of image descriptors, by which places are recognised."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class Dinov2Settings(Settings):
    """A vision transformer of the transformers library, in a local folder."""

    folder: Path | None = Field(None, description="config.json and weights, e.g. of ViT-S/14")
    pooling: Literal["class", "mean"] = Field("class", description="class token, or patches' mean")
    longest_side: int = Field(224, ge=14, description="pixels that images are scaled to")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where it runs")


class FeatureSettings(Settings):
    """What turns a view into a descriptor."""

    kind: Literal["builtin", "dinov2", "colour-histogram"] = Field(
        "builtin", description="without weights, a model's, or the baseline"
    )
    source: Literal["rgb", "semantic", "both"] = Field(
        "rgb", description="the colour image, the classes in colours (G), or both"
    )
    dinov2: Dinov2Settings = Dinov2Settings()
