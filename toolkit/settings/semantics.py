"""Settings of semantics: where labels come from, and what the map makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings

CodeKind = Literal["none", "flat", "one-hot", "binary", "colour"]


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
    min_confidence: float = Field(0.5, ge=0, le=1, description="void below it, a probability")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where it runs")


class GeometricSettings(Settings):
    """Floor, wall, ceiling, surface and object from depth alone."""

    columns: int = Field(160, ge=16, description="most cells across the image")
    min_camera_height_m: float = Field(0.5, gt=0, description="above the floor, m")
    max_camera_height_m: float = Field(2.5, gt=0, description="above the floor, m")


class SegmenterSettings(Settings):
    """Where labels come from."""

    kind: Literal["auto", "recorded", "images", "geometric", "model", "none"] = Field(
        "auto", description="auto: the data set's own labels, or geometric without any"
    )
    images: LabelImageSettings = LabelImageSettings()
    model: ModelSettings = ModelSettings()
    geometric: GeometricSettings = GeometricSettings()


class CodeSettings(Settings):
    """How a class becomes numbers."""

    kind: CodeKind = Field("one-hot", description="none makes a map without semantics")
    start_confidence: float = Field(0.9, gt=0.5, lt=1, description="of a new Gaussian's heads")
    normalise: bool = Field(True, description="weigh heads by the logarithm of their width")


class SemanticLossSettings(Settings):
    """Weights of the semantic loss (H-9)."""

    weight: float = Field(0.2, ge=0, description="beside colour and depth (G-3: 0.5)")
    every: int = Field(3, ge=1, description="steps of mapping for one that takes semantics in")
    intra: float = Field(1.0, ge=0, description="of the code's own questions (w1)")
    inter: float = Field(5.0, ge=0, description="of the network's flat classes (w2)")
    inter_from: int = Field(15, ge=0, description="first step of a call that counts it (eta)")
    inter_pixels: int = Field(2048, ge=0, description="pixels the network sees; 0 is all")
    structure: float = Field(
        0.0, ge=0, le=1, description="share of SSIM in the colour code's loss (G-4: 0.2)"
    )
    min_silhouette: float = Field(0.5, gt=0, lt=1, description="thinner pixels do not count")
    moves_geometry: bool = Field(False, description="let semantics move Gaussians, as in H")


class NetworkSettings(Settings):
    """The small network that reads codes as flat classes (H-12)."""

    use: bool = Field(False, description="train it, and with it the inter-level term")
    hidden: int = Field(64, ge=1, description="units between its two layers")
    learning_rate: float = Field(5e-3, gt=0, description="of its optimiser")
    replay: int = Field(
        16, ge=0, description="samples of each class that every step rehearses, of all submaps"
    )


class SemanticsSettings(Settings):
    """What the map's Gaussians are taught to be."""

    taxonomy: str = Field(
        "auto", description="file, name of a shipped tree, or auto: one that has the classes"
    )
    ignore: tuple[str, ...] = Field(
        (), description="classes or groups left out of tracking and mapping"
    )
    reader: Literal["path", "network"] = Field("path", description="decodes what was learned")
    min_confidence: float = Field(
        0.5, ge=0.5, lt=1, description="a level below it is left open in the map's file"
    )
    segmenter: SegmenterSettings = SegmenterSettings()
    code: CodeSettings = CodeSettings()
    loss: SemanticLossSettings = SemanticLossSettings()
    network: NetworkSettings = NetworkSettings()
