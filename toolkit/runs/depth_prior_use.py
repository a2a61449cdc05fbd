"""What a finished run reports about the depth priors that it used."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.depth.depth_priors.provider import PriorModel
from toolkit.slam.submaps.atlas import Atlas


@dataclass(frozen=True)
class DepthPriorUse:
    """Depth priors of a run.

    Attributes:
        model: that predicted them.
        inferred: fraction of the keyframes' depth that follows from priors, in [0, 1].
        correction: of priors that were used alone, or None.
    """

    model: PriorModel
    inferred: float
    correction: DepthCorrection | None = None

    def metrics(self) -> dict[str, float | int | str | None]:
        """Group "depth_prior" of metrics.json."""
        return {
            "model": self.model.name,
            "sha256": self.model.sha256,
            "licence": self.model.licence,
            "inferred_percent": 100.0 * self.inferred,
            "groups": None if self.correction is None else len(self.correction.found),
        }


def inferred_fraction(atlas: Atlas) -> float:
    """Fraction of the pixels with depth of all keyframes whose depth follows from priors."""
    inferred = known = 0
    for number in atlas.readable():
        for keyframe in atlas.submap(number).keyframes:
            with_depth = keyframe.depth_m > 0
            known += int(with_depth.sum())
            if keyframe.prior_m is not None:
                inferred += int(with_depth.sum())
            elif keyframe.inferred is not None:
                inferred += int((with_depth & keyframe.inferred).sum())
    return inferred / known if known else 0.0
