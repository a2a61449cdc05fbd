"""Options of loop detection and relocalisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    Range,
)

Weighting = Literal["sqrt", "linear", "inverse", "paper"]
Counted = Literal["pixels", "gaussians"]


@dataclass(frozen=True)
class CandidateOptions:
    """Selection of loop candidates by image descriptors."""

    search_every: PositiveInt = 6
    """Number of keyframes between searches for loop candidates."""
    considered: PositiveInt = 10
    """Number of nearest keyframes considered in a search."""
    kept: PositiveInt = 3
    """Maximum number of candidates passed to verification, at most one per submap before a second
    of any (GauSem-SLAM: 1)."""
    threshold: Literal["rank", "fixed", "adaptive"] = "rank"
    """Maximum descriptor distance of a candidate: none, so that the nearest keyframes are verified
    whatever their distance (rank), the encoder's (fixed), or derived from the distances within the
    query's submap (adaptive)."""
    distance: Annotated[float, Range(gt=0, le=2)] | None = None
    """Maximum Euclidean distance of two descriptors. By default, the encoder's for the fixed and
    the adaptive threshold, and none for selection by rank."""
    min_gap_frames: PositiveInt = 30
    """Minimum number of frames between query and match."""
    min_gap_m: NonNegativeFloat = 0.5
    """Minimum path length between query and match, in metres."""


@dataclass(frozen=True)
class LandmarkOptions:
    """Landmark vectors: the weighted class counts of a view. They order the candidates below a
    fixed or adaptive descriptor distance; candidates selected by rank are ordered by descriptor."""

    weighting: Weighting = "sqrt"
    """Weight of a class: the square root of its fraction of the view (sqrt), the fraction (linear),
    the inverse of the fraction (inverse), or equation 7 of GauSem-SLAM as printed, which needs
    counted gaussians (paper)."""
    min_count: NonNegativeInt = 10
    """Minimum count for a class to be seen by a keyframe; the weighting inverse takes smaller
    counts as this one, and paper ignores it."""
    counted: Counted = "pixels"
    """What is counted per class: the labelled pixels of a keyframe (pixels) or the Gaussians that
    it observes as in GauSem-SLAM (gaussians)."""


@dataclass(frozen=True)
class ObjectOptions:
    """Loop candidates from constellations of objects, whatever their appearance: of the connected
    parts of each class, and of the instances of --instances if they are on. They need labels of
    object classes."""

    use: bool = False
    """Register two submaps from the places of their objects if their images do not match."""


@dataclass(frozen=True)
class RelocalisationOptions:
    """Relocalisation of a lost camera."""

    patience: PositiveInt = 15
    """Number of consecutive doubtful or lost frames after which a new submap is started; at low
    frame rates, it is started after three frames and a second."""
