"""Settings of the semantic half: where labels come from."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class LabelImageSettings(Settings):
    """A folder of label images from any tool."""

    folder: Path | None = Field(None, description="STEM.png files and classes.json")
    pairing: Literal["stem", "number"] = Field(
        "stem", description="a file is called like the frame's image, or has its index"
    )
    gaps: bool = Field(False, description="frames without a file are void, not an error")


class ModelSettings(Settings):
    """A segmentation model of the transformers library, in a local folder."""

    folder: Path | None = Field(None, description="config.json, weights, image processor")
    head: Path | None = Field(None, description="of `semsplat train-head`; then an encoder's")
    least_confidence: float = Field(0.5, ge=0, le=1, description="void below it, a probability")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where it runs")


class GeometricSettings(Settings):
    """Floor, wall, ceiling, surface and object from depth alone."""

    columns: int = Field(160, ge=16, description="most cells across the image")
    least_camera_height_m: float = Field(0.5, gt=0, description="above the floor, m")
    most_camera_height_m: float = Field(2.5, gt=0, description="above the floor, m")


class SegmenterSettings(Settings):
    """Where labels come from."""

    kind: Literal["auto", "recorded", "images", "geometric", "model", "none"] = Field(
        "auto", description="auto: the data set's own labels, or geometric without any"
    )
    images: LabelImageSettings = LabelImageSettings()
    model: ModelSettings = ModelSettings()
    geometric: GeometricSettings = GeometricSettings()
