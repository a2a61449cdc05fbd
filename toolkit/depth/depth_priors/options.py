"""Options of depth priors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from toolkit.base.options import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt

PriorKind = Literal[
    "none",
    "maps",
    "transformers",
    "dust3r",
    "mast3r",
    "depth-anything-3",
    "moge",
    "vggt",
]


@dataclass(frozen=True)
class DepthMapOptions:
    """Depth maps in a folder, written by any program."""

    folder: Path | None = None
    """Folder with one map per frame, named like the frame's image (STEM.npy, .png, .tif or .exr);
    required for this source. 16-bit PNG files are in thousandths."""
    values: Literal["metric", "scaled", "affine", "affine-inverse"] = "scaled"
    """What the maps contain: depth in metres (metric), depth up to scale (scaled), up to scale and
    shift (affine), or inverse depth up to scale and shift (affine-inverse)."""
    scope: Literal["frame", "set", "sequence"] = "frame"
    """Which maps share scale and shift: none (frame), those of a set, or all (sequence)."""


@dataclass(frozen=True)
class PriorModelOptions:
    """A model that predicts depth."""

    path: Path | None = None
    """Local folder or file with the weights; required for all sources except maps."""
    values: Literal["auto", "metric", "scaled", "affine", "affine-inverse"] = "auto"
    """What a model of the transformers library predicts, as in --depth-prior.maps.values; by
    default according to its configuration (auto)."""
    min_confidence: NonNegativeFloat = 0.0
    """Minimum confidence of a pixel, in the unit of the model (see the guide). By default, all
    pixels are used."""
    code: Path | None = None
    """Folder with the model's repository, for packages that pip cannot install (dust3r, mast3r)."""


@dataclass(frozen=True)
class ScaleCorrectionOptions:
    """Alignment of priors with known depth (Hier-SLAM++, equations 16 and 17)."""

    robust: bool = True
    """Tolerate outliers, and attribute noise to the prior. Otherwise, plain least squares as
    printed in Hier-SLAM++."""
    share: Literal["scope", "frame"] = "scope"
    """Which frames have a common scale and shift: according to the model (scope), or none
    (frame)."""
    grid: PositiveInt = 3
    """Number of nodes per axis of a smooth grid of corrections; 1 uses one scale and shift."""
    min_silhouette: Fraction = 0.9
    """Minimum silhouette of the map in pixels that the prior is compared with."""
    filter: bool = True
    """Remove single pixels that differ from those around them, and smooth noise."""


@dataclass(frozen=True)
class DepthPriorOptions:
    """Depth of images without a depth sensor, from a model or from files."""

    kind: PriorKind = "none"
    """Source of depth priors: depth maps in a folder (maps), a model of the transformers library
    (transformers), another package, or none."""
    use: Literal["complete", "correct", "track"] = "complete"
    """Complete the depth from neighbouring keyframes where it is unknown (complete), or use the
    prior alone, corrected with the depth of the map as in Hier-SLAM++ (correct). With track, frames
    are also tracked against the map with that depth, as in Hier-SLAM++, instead of by visual
    odometry; --tracking selects the tracker."""
    size: PositiveInt = 8
    """Number of images that models for several images receive together (Hier-SLAM++: S)."""
    stride: PositiveInt = 4
    """Number of frames between the images of a set (Hier-SLAM++: delta). To complete the depth of
    keyframes, consecutive keyframes are a set."""
    max_noise: PositiveFloat = 0.15
    """Maximum relative error of a prior on known depth; a prior with a larger one does not complete
    a keyframe."""
    maps: DepthMapOptions = DepthMapOptions()
    model: PriorModelOptions = PriorModelOptions()
    correction: ScaleCorrectionOptions = ScaleCorrectionOptions()
