"""Baseline: registration in both directions, view by view, as in LoopSplat.

Each keyframe of the source is registered to the target on its own, and each keyframe of the
target to the source. A robust mean combines the poses. Renderer, optimiser, stopping criterion
and start are those of the fine stage, so that only the scheme differs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import ResidualScales
from toolkit.geometry import se3
from toolkit.registration.fine import FineRegistration
from toolkit.registration.motion_average import MotionAverage, average_motion
from toolkit.registration.options import AverageOptions
from toolkit.registration.result import RegistrationResult, failed
from toolkit.registration.views import views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


class TwoWayRegistration:
    """Registers two submaps from a start close to the solution; see Registrar.

    Args:
        fine: registers single views.
        average: of the robust mean.
    """

    def __init__(
        self, fine: FineRegistration | None = None, average: AverageOptions | None = None
    ) -> None:
        self._fine = fine or FineRegistration()
        self.renderer, self.options = self._fine.renderer, self._fine.options
        self._average = average or AverageOptions()

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; without a start it begins at the identity."""
        start = np.eye(4) if T_target_source is None else T_target_source
        return self.refine(target, source, start)

    def refine(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> RegistrationResult:
        """See Refiner; the views are of the source, the target's own choose themselves."""
        before = self.renderer.renders
        there, poses = self._placed(target, source, start, views)
        back, other_poses = self._placed(source, target, se3.inverse(start))
        # A target view's pose, seen from the source, is where the inverse motion takes it.
        placed = [r.T_target_source @ T for r, T in zip(there, poses, strict=True)]
        placed += list(other_poses)
        unplaced = list(poses)
        unplaced += [r.T_target_source @ T for r, T in zip(back, other_poses, strict=True)]
        if not placed:
            return failed("two-way", "no view could be placed in the other submap", start)
        average = average_motion(np.array(placed), np.array(unplaced), self._average)
        renders = self.renderer.renders - before
        return self._result(average, [*there, *back], renders)

    def _placed(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> tuple[list[RegistrationResult], list[Array]]:
        """Each view of the source registered on its own, and its pose in the source."""
        results, poses = [], []
        if views is None:
            views = views_of_overlap(target, source, start, self.options.views)
        for place in views:
            result = self._fine.refine(target, source, start, [place])
            if result.converged:
                results.append(result)
                poses.append(source.keyframes[place].T_map_camera)
        return results, poses

    def _result(
        self, average: MotionAverage, parts: list[RegistrationResult], renders: int
    ) -> RegistrationResult:
        """Judged by the views as each was placed: nothing is drawn again."""
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
