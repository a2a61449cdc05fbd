"""Options of semantics: source of labels, code of the classes, semantic loss."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from toolkit.base.options import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
)

CodeKind = Literal["none", "flat", "one-hot", "binary", "colour"]


@dataclass(frozen=True)
class ObjectOptions:
    """Options of the extraction of objects.

    Attributes:
        link_m: maximum distance of neighbouring Gaussians of one object, in metres.
        min_gaussians: minimum number of Gaussians of an object; smaller pieces are noise.
        min_confidence: minimum confidence of a Gaussian's label, in [0, 1].
    """

    link_m: float = 0.06
    min_gaussians: int = 30
    min_confidence: float = 0.0


@dataclass(frozen=True)
class LabelImageOptions:
    """Label images in a folder, written by any program."""

    folder: Path | None = None
    """Folder with label images (STEM.png) and classes.json; required for this segmenter."""
    pairing: Literal["stem", "number"] = "stem"
    """How label images are assigned to frames: by the name of the frame's image (stem) or by the
    frame's index (number)."""
    gaps: bool = False
    """Treat frames without a label image as unlabelled instead of an error."""


@dataclass(frozen=True)
class ModelOptions:
    """A segmentation model in the format of transformers, or a trained head."""

    folder: Path | None = None
    """Local folder with config.json, the weights and the image processor; required unless there is
    a head for the indoor network."""
    head: Path | None = None
    """Head trained by `semsplat train-head`. The model, by default the indoor network, is then used
    as an encoder."""


@dataclass(frozen=True)
class GeometricOptions:
    """Labels from depth alone (indoor and geometric)."""

    camera_height_m: tuple[PositiveFloat, PositiveFloat] = (0.5, 2.5)
    """Minimum and maximum height of the camera above the floor, in metres. Higher level surfaces
    are furniture, lower ones belong to another storey."""


@dataclass(frozen=True)
class SegmenterOptions:
    """Source of the labels."""

    kind: Literal["auto", "recorded", "images", "indoor", "geometric", "model", "none"] = "auto"
    """Source of labels: the dataset (recorded), images, depth by a network (indoor) or planes
    (geometric), a model, none, or recorded if available, else indoor (auto)."""
    images: LabelImageOptions = LabelImageOptions()
    model: ModelOptions = ModelOptions()
    geometric: GeometricOptions = GeometricOptions()


@dataclass(frozen=True)
class CodeOptions:
    """The code by which Gaussians store classes."""

    kind: CodeKind = "one-hot"
    """Code of the classes: one softmax (flat), one per level of the tree (one-hot), bits per level
    (binary), colours as in GauSem-SLAM (colour), or no semantics (none)."""
    start: Literal["labels", "random"] = "labels"
    """Code of a new Gaussian: that of the class of its pixel (labels), or standard normal values as
    in Hier-SLAM++ (random), which the colour code does not support."""
    normalise: bool = True
    """Divide the loss of each level, and that of the network, by that of a uniform prediction."""


@dataclass(frozen=True)
class SemanticLossWeights:
    """Weights of the semantic mapping loss."""

    weight: NonNegativeFloat = 0.2
    """Weight of the semantic loss relative to the colour and depth losses (Hier-SLAM++: 0.2,
    GauSem-SLAM: 0.5). Its part within the levels of the tree has weight 1, and that across levels,
    computed by the network, 5 (Hier-SLAM++: omega 1 and 2)."""
    every: PositiveInt = 3
    """Number of mapping iterations per iteration that includes the semantic loss. The final
    refinement includes it in every iteration."""
    inter_from: NonNegativeInt = 15
    """First iteration of a mapping call with the loss across levels (Hier-SLAM++: eta), at the
    latest after a quarter of the call."""
    inter_pixels: NonNegativeInt = 2048
    """Number of pixels per iteration that the network processes; 0 processes all."""
    structure: Fraction = 0.0
    """Fraction of SSIM in the loss of the colour code (GauSem-SLAM: 0.2)."""
    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.5
    """Minimum silhouette of the pixels included in the semantic loss."""
    moves_geometry: bool = False
    """Propagate gradients of the semantic loss to the geometry, as in Hier-SLAM++."""


@dataclass(frozen=True)
class NetworkOptions:
    """The network that decodes codes to flat classes (Hier-SLAM++, equation 12)."""

    use: bool = False
    """Train the network, and with it the loss across levels."""
    replay: NonNegativeInt = 16
    """Number of samples per class, from all submaps, that every training step repeats."""


@dataclass(frozen=True)
class SemanticsOptions:
    """Semantics of the map."""

    taxonomy: str = "auto"
    """Tree of classes: a YAML file, the name of a bundled tree, or auto to select or build one
    that contains the classes."""
    ignore: tuple[str, ...] = ()
    """Classes, groups, nouns (as whole masks with --instances.kind folder or model) that are not
    tracked against or mapped, such as people."""
    reader: Literal["path", "network"] = "path"
    """Decoder of the codes: the path through the tree (path) or the trained network (network)."""
    min_confidence: Annotated[float, Range(ge=0.5, lt=1)] = 0.5
    """Minimum probability of a level of the tree in the exported map. Levels below it are
    unlabelled."""
    code: CodeOptions = CodeOptions()
    loss: SemanticLossWeights = SemanticLossWeights()
    network: NetworkOptions = NetworkOptions()
