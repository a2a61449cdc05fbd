"""Baseline: registration in both directions, view by view, as in LoopSplat.

Each keyframe of the source is registered to the target separately, and each keyframe of the target
to the source. A robust mean combines the poses. Renderer, optimiser, stopping criterion and initial
pose are those of the fine stage, so that only the scheme differs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.motion_average import MotionAverage, average_motion
from toolkit.slam.loops.registration.result import RegistrationResult, failed
from toolkit.slam.loops.registration.views import views_of_overlap
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import ResidualScales

Array = NDArray[np.float64]


class TwoWayRegistration:
    """Registers two submaps from a start close to the solution; see Registrar.

    Args:
        fine: registers single views.
    """

    def __init__(self, fine: FineRegistration | None = None) -> None:
        self._fine = fine or FineRegistration()
        self.renderer, self.options = self._fine.renderer, self._fine.options

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; the default initial pose is the identity."""
        start = np.eye(4) if T_target_source is None else T_target_source
        return self.refine(target, source, start)

    def refine(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> RegistrationResult:
        """See Refiner; `views` are keyframes of the source, those of the target are chosen."""
        before = self.renderer.renders
        forward, source_poses = self._register_views(target, source, start, views)
        backward, target_poses = self._register_views(source, target, se3.inverse(start))
        # Poses of all views in the target and in the source.
        in_target = [r.T_target_source @ T for r, T in zip(forward, source_poses, strict=True)]
        in_target += list(target_poses)
        in_source = list(source_poses)
        in_source += [r.T_target_source @ T for r, T in zip(backward, target_poses, strict=True)]
        if not in_target:
            return failed("two-way", "no view could be placed in the other submap", start)
        average = average_motion(
            np.array(in_target), np.array(in_source), agree_within=self.options.agree_within
        )
        renders = self.renderer.renders - before
        return self._result(average, [*forward, *backward], renders)

    def _register_views(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> tuple[list[RegistrationResult], list[Array]]:
        """Register each view of the source separately.

        Returns:
            The results that converged, and the poses [4, 4] of their views in the source.
        """
        results, poses = [], []
        if views is None:
            views = views_of_overlap(target, source, start, self.options.views)
        for index in views:
            result = self._fine.refine(target, source, start, [index])
            if result.converged:
                results.append(result)
                poses.append(source.keyframes[index].T_map_camera)
        return results, poses

    def _result(
        self, average: MotionAverage, parts: list[RegistrationResult], renders: int
    ) -> RegistrationResult:
        """Combine the quality of the single views; no further views are rendered."""
        enough = bool(average.inliers.sum() * 2 >= len(parts))
        return RegistrationResult(
            T_target_source=average.T_target_source,
            converged=average.converged and enough,
            inliers=_median([part.inliers for part in parts]),
            residual=ResidualScales(
                _median([part.residual.intensity for part in parts]),
                _median([part.residual.depth_m for part in parts]),
            ),
            overlap=_median([part.overlap for part in parts]),
            class_agreement=_median([part.class_agreement for part in parts]),
            information=average.information,
            iterations=average.iterations + sum(part.iterations for part in parts),
            renders=renders,
            method="two-way",
            reason="" if enough else "the views disagree",
        )


def _median(values: list[float]) -> float:
    return float(np.median(values))
