"""Whether the alignment of a frame to a view of the map is reliable, doubtful or wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import Alignment, LevelProblem
from toolkit.alignment.determinacy import Determinacy, determinacy
from toolkit.alignment.health import HealthLimits, failure_reason
from toolkit.alignment.similarity import Similarity, aligned_correlation
from toolkit.frame import Recorder
from toolkit.geometry import se3
from toolkit.stages import Stage
from toolkit.tracking.evidence import doubt_reason, lacks_texture
from toolkit.tracking.result import Health
from toolkit.tracking.views import RenderedView, Task

# Pyramid level at which the agreement of a frame and the map is measured, and width below which
# it is the finest one: blocks of fewer pixels have no correlation.
_LEVEL, _MIN_WIDTH = 1, 80


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is known about the result of an alignment.

    Attributes:
        reason: why the frame is doubtful or lost; empty if it is neither.
        visible: fraction of the measured pixels that were aligned.
        information: [6, 6] of the pose at the finest level; 0 if nothing was aligned.
        determinacy: of the alignment.
    """

    health: Health
    reason: str
    similarity: Similarity
    visible: float
    information: NDArray[np.float64]
    determinacy: Determinacy | None = None
    determined: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))


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
    found = None
    with recorder.timed(Stage.TRACKING_EVIDENCE):
        similarity = aligned_correlation(model, frame, T_view_camera)
        if not reason:
            scales, exposure = alignment.scales, alignment.exposure
            gate = max_distance * 2**level
            found = determinacy(LevelProblem(model, frame, T_view_camera, scales, exposure, gate))
            rise = float(found.rises.min()) if lacks_texture(similarity) else None
            reason = doubt_reason(similarity, rise)
            health = Health.DOUBTFUL if reason else health
    adjoint = se3.adjoint(T_view_camera)
    determined = np.zeros((6, 6)) if found is None else adjoint.T @ found.information @ adjoint
    return Judgement(health, reason, similarity, visible, information, found, determined)


def _level(task: Task) -> int:
    """Pyramid level at which a frame is compared with the map."""
    coarser = [level.camera.width >= _MIN_WIDTH for level in task.levels[1:]]
    return _LEVEL if any(coarser) else 0
