"""Options of instances: the source of the masks, and the size of voxels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from toolkit.options import NonNegativeInt, PositiveFloat


@dataclass(frozen=True)
class InstanceOptions:
    """Objects that are told apart even where they touch and have the same class."""

    kind: Literal["none", "folder", "geometric"] = "none"
    """Source of the masks of single views: files of any program (folder), depth, colour and class
    labels (geometric), or none. Ids of masks may restart in every frame."""
    path: Path | None = None
    """Folder with images of mask ids (NNNNNN.png, 8 or 16 bits, 0 for no mask) and optional
    NNNNNN.npz with classes, scores and embeddings; or a COCO file (.json). Required for folder."""
    pairing: Literal["number", "stem"] = "number"
    """How mask images are assigned to frames: by the frame's index (number) or by the name of the
    frame's image (stem)."""
    voxel_m: PositiveFloat = 0.04
    """Edge of the voxels whose overlap identifies objects, in metres."""
    min_gaussians: NonNegativeInt = 20
    """Minimum number of Gaussians of an object. Those of smaller ones belong to no object."""
