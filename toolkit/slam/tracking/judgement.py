"""Whether the alignment of a frame to a view of the map is reliable, doubtful or wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Recorder
from toolkit.base.geometry import se3
from toolkit.base.stages import Stage
from toolkit.slam.tracking.combination import Combination, combined, is_determined
from toolkit.slam.tracking.evidence import doubt_reason
from toolkit.slam.tracking.result import Health
from toolkit.slam.tracking.views import RenderedView, Task
from toolkit.splatting.alignment.data import Alignment, LevelProblem
from toolkit.splatting.alignment.determinacy import determinacy
from toolkit.splatting.alignment.health import HealthLimits, failure_reason
from toolkit.splatting.alignment.similarity import Similarity, aligned_correlation

# Pyramid level at which the agreement of a frame and the map is measured, and width below which
# it is the finest one: blocks of fewer pixels have no correlation.
_LEVEL, _MIN_WIDTH = 1, 80


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is known about the result of an alignment.

    Attributes:
        pose: with what the features tell.
        reason: why the frame is doubtful or lost; empty if it is neither.
        ambiguous: whether other motions explain the frame as well.
        visible: fraction of the measured pixels that were aligned.
        information: [6, 6] of the pose at the finest level; 0 if nothing was aligned.
    """

    pose: Combination
    health: Health
    reason: str
    ambiguous: bool
    similarity: Similarity
    visible: float
    information: NDArray[np.float64]


def judged(
    limits: HealthLimits,
    task: Task,
    view: RenderedView,
    alignment: Alignment,
    max_distance: float,
    recorder: Recorder,
) -> Judgement:
    """Judge the alignment of a frame to a view.

    Args:
        max_distance: maximum depth difference of corresponding pixels at the finest level, as a
            fraction of depth.
    """
    measured, linear = float(task.prepared.measured), alignment.last
    visible = linear.depth_pixels / max(measured, 1.0) if linear else 0.0
    # The perturbation is in the view's frame; the view is close to the estimated pose.
    information = linear.H[:6, :6] if linear else np.zeros((6, 6))
    reason = failure_reason(limits, alignment.scales, visible, information, measured)
    health = Health.LOST if reason else Health.GOOD
    level = _level(task)
    model, frame, T_view_camera = view.levels[level], task.levels[level], alignment.T_view_camera
    # Alignment that fails immediately returns a product of the tracker's own poses. Without
    # orthonormalisation, rounding errors would accumulate over a few hundred such frames.
    T_map_camera = se3.orthonormalise(view.T_map_view @ T_view_camera)
    pose = combined(T_map_camera, np.zeros((6, 6)), None)
    ambiguity = ""
    with recorder.timed(Stage.TRACKING_EVIDENCE):
        similarity = aligned_correlation(model, frame, T_view_camera)
        if not reason:
            scales, exposure, gate = alignment.scales, alignment.exposure, max_distance * 2**level
            problem = LevelProblem(model, frame, T_view_camera, scales, exposure, gate)
            # Where features determine the pose, the rise of the cost only has to weigh it.
            alone = task.features is None or not is_determined(task.features.information)
            found = determinacy(problem, refit=alone)
            pose = combined(T_map_camera, found.in_frame(T_view_camera), task.features)
            reason = doubt_reason(similarity)
            # What the cost beside a wrong pose determines says nothing about the view.
            if not reason or pose.motions is not None:
                ambiguity = pose.ambiguity(task.after_ambiguous)
            reason = reason or ambiguity
            health = Health.DOUBTFUL if reason else health
    return Judgement(pose, health, reason, bool(ambiguity), similarity, visible, information)


def _level(task: Task) -> int:
    """Pyramid level at which a frame is compared with the map."""
    coarser = [level.camera.width >= _MIN_WIDTH for level in task.levels[1:]]
    return _LEVEL if any(coarser) else 0
