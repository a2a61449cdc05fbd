"""Settings of semantics."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings

CodeKind = Literal["none", "flat", "one-hot", "binary", "colour"]


class CodeSettings(Settings):
    """How a class becomes numbers."""

    kind: CodeKind = Field("one-hot", description="none makes a map without semantics")
    start_confidence: float = Field(0.9, gt=0.5, lt=1, description="of a new Gaussian's heads")
    normalise: bool = Field(True, description="weigh heads by the logarithm of their width")


class SemanticLossSettings(Settings):
    """Weights of the semantic loss (H-9)."""

    weight: float = Field(0.2, ge=0, description="beside colour and depth (G-3: 0.5)")
    intra: float = Field(1.0, ge=0, description="of the code's own questions (w1)")
    inter: float = Field(5.0, ge=0, description="of the network's flat classes (w2)")
    inter_from: int = Field(15, ge=0, description="first step of a call that counts it (eta)")
    inter_pixels: int = Field(2048, ge=0, description="pixels the network sees; 0 is all")
    least_silhouette: float = Field(0.5, gt=0, lt=1, description="thinner pixels do not count")
    moves_geometry: bool = Field(False, description="let semantics move Gaussians, as in H")


class NetworkSettings(Settings):
    """The small network that reads codes as flat classes (H-12)."""

    use: bool = Field(False, description="train it, and with it the inter-level term")
    hidden: int = Field(64, ge=1, description="units between its two layers")
    learning_rate: float = Field(5e-3, gt=0, description="of its optimiser")


class SemanticsSettings(Settings):
    """What the map's Gaussians are taught to be."""

    taxonomy: str = Field(
        "auto", description="file, name of a shipped tree, or auto: one that has the classes"
    )
    ignore: tuple[str, ...] = Field(
        (), description="classes or groups left out of tracking and mapping"
    )
    reader: Literal["path", "network"] = Field("path", description="decodes what was learned")
    least_confidence: float = Field(
        0.5, ge=0.5, lt=1, description="a level below it is left open in the map's file"
    )
    code: CodeSettings = CodeSettings()
    loss: SemanticLossSettings = SemanticLossSettings()
    network: NetworkSettings = NetworkSettings()
