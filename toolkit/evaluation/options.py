"""Options of the evaluation of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class EvaluationOptions:
    """Additional metrics computed at the end of a run."""

    lpips_weights: tuple[Path, ...] = ()
    """Files with the weights of LPIPS: torchvision's AlexNet and the linear weights of the lpips
    package, or one file with both. By default, LPIPS is not computed."""
    subset: bool = False
    """Compute the papers' subset mIoU, for which each view is decoded among the classes of its
    ground-truth labels only."""
