"""Options of instances: the source of the masks, and the size of voxels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from toolkit.base.options import Fraction, NonNegativeInt, PositiveFloat, PositiveInt


@dataclass(frozen=True)
class InstanceModelOptions:
    """A model of transformers that yields masks: SAM 2, Mask2Former, OneFormer, Grounding DINO."""

    folder: Path | None = None
    """Local folder with config.json, the weights and preprocessor_config.json; OneFormer and
    Grounding DINO also need their tokenizer. Required for model."""
    text: tuple[str, ...] = ()
    """Words that Grounding DINO searches, such as chair "coffee table". They become the classes."""
    min_score: Fraction | None = None
    """Minimum score of a mask. Default: 0.5, SAM 2: 0.8, Grounding DINO: 0.3."""
    points: PositiveInt = 16
    """Number of points per side of the image from which SAM 2 makes masks."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device that runs the model."""


@dataclass(frozen=True)
class InstanceOptions:
    """Objects that are told apart even where they touch and have the same class."""

    kind: Literal["none", "folder", "geometric", "model"] = "none"
    """Source of the masks of single views: files of any program (folder), depth, colour and class
    labels (geometric), a model (model), or none. Ids of masks may restart in every frame."""
    path: Path | None = None
    """Folder with images of mask ids (NNNNNN.png, 8 or 16 bits, 0 for no mask) and optional
    NNNNNN.npz with classes, scores and embeddings; or a COCO file (.json). Required for folder."""
    pairing: Literal["number", "stem"] = "number"
    """How mask images are assigned to frames: by the frame's index (number) or by the name of the
    frame's image (stem)."""
    model: InstanceModelOptions = InstanceModelOptions()
    encoder: Path | None = None
    """Folder of the model, such as CLIP or SigLIP, that made the embeddings of the masks:
    --semantics.ignore accepts any texts, and also ignores masks whose embeddings are nearest to
    one of them."""
    voxel_m: PositiveFloat = 0.04
    """Edge of the voxels whose overlap identifies objects, in metres."""
    min_gaussians: NonNegativeInt = 20
    """Minimum number of Gaussians of an object. Those of smaller ones belong to no object."""
