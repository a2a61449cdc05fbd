"""Whether two frames show one place: what a new part of the map must start with.

A part whose first frame no other frame can be aligned to is useless, and one on a blank wall would
track noise. Unrelated photos and views of nothing therefore never start a part.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.slam.tracking.combination import combined
from toolkit.slam.tracking.evidence import doubt_reason
from toolkit.slam.tracking.proposals import FeatureProposals
from toolkit.splatting.alignment.data import LevelProblem
from toolkit.splatting.alignment.determinacy import determinacy
from toolkit.splatting.alignment.joint import MAX_DISTANCE, Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import finest_level, model_level, pyramid
from toolkit.splatting.alignment.similarity import aligned_correlation

Array = NDArray[np.float64]

# Pyramid level at which the alignment is judged.
_LEVEL = 1


def shows_same_place(first: Frame, second: Frame) -> bool:
    """Whether two frames can be aligned to each other without doubt.

    Args:
        first, second: with depth.
    """
    options = JointOptions()
    model, frame = (
        pyramid(finest_level(image, torch.device("cpu")), options.levels)
        for image in (first, second)
    )
    models = [model_level(level) for level in model]
    gate = MAX_DISTANCE * 2**_LEVEL
    for start in _starts(first, second):
        found = align([Pair(models, frame, np.eye(4), np.eye(4))], Estimate(start), options)
        T, exposure = found.T_target_source, Exposure(*(float(v) for v in found.exposures[0]))
        similarity = aligned_correlation(models[_LEVEL], frame[_LEVEL], T)
        determined = determinacy(
            LevelProblem(models[_LEVEL], frame[_LEVEL], T, found.scales, exposure, gate),
            refit=True,
        )
        pose = combined(T, determined.in_frame(T), None)
        if not (doubt_reason(similarity) or pose.ambiguity()):
            return True
    return False


def _starts(first: Frame, second: Frame) -> Iterator[Array]:
    """Initial motions [4, 4]: none, and that of feature matches."""
    yield np.eye(4)
    keyframe = Keyframe.from_frame(first, np.eye(4))
    yield from FeatureProposals().poses(second, [keyframe], lambda _view: [])
