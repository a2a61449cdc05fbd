"""Options of the evaluation of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from toolkit.base.options import NonNegativeFloat


@dataclass(frozen=True)
class TruthErrorOptions:
    """Error of the ground truth itself, which loop edges are allowed in addition."""

    truth_error_m: NonNegativeFloat = 0.0
    """Error of the ground truth's relative positions, in metres. A loop edge is right within 5 cm
    and 2 degrees of the ground truth, plus the ground truth's own error."""
    truth_error_deg: NonNegativeFloat = 0.0
    """Error of the ground truth's relative rotations, in degrees."""
    truth_error_s: NonNegativeFloat = 0.0
    """Error of the ground truth's times relative to the images, in seconds. It counts as much as
    the relative pose of the two frames changes in this time. Motion capture is often 0.01 to 0.02 s
    off."""


@dataclass(frozen=True)
class EvaluationOptions:
    """Additional metrics computed at the end of a run."""

    lpips_weights: tuple[Path, ...] = ()
    """Files with the weights of LPIPS: torchvision's AlexNet and the linear weights of the lpips
    package, or one file with both. By default, LPIPS is not computed."""
    subset: bool = False
    """Compute the papers' subset mIoU, for which each view is decoded among the classes of its
    ground-truth labels only."""
    truth: TruthErrorOptions = TruthErrorOptions()
