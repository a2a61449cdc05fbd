"""Fine registration: aligns rendered views of the source to the target at the same poses (G-6).

It works in one direction and does not change the maps. The optimiser is a joint Gauss-Newton over
all views, which ignores pixels whose classes differ. The paper's own loss and optimiser are a
baseline, see `toolkit.slam.loops.registration.first_order_fine`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.quality import AlignmentCheck, compare
from toolkit.slam.loops.registration.result import RegistrationResult, failed
from toolkit.slam.loops.registration.views import SubmapView, ViewRenderer, views_of_overlap
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.covariance import clustered_information
from toolkit.splatting.alignment.data import ModelLevel
from toolkit.splatting.alignment.joint import MIN_PIXELS, Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import model_level, pyramid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SourceView:
    """A rendered view of the source, its pose [4, 4], and the median depth of its surface (m)."""

    view: SubmapView
    T_source_camera: Array
    median_depth_m: float


@dataclass(frozen=True)
class TargetView:
    """The target rendered at the estimated pose [4, 4] of a view of the source."""

    view: SubmapView
    T_target_view: Array
    model: list[ModelLevel]


# A depth camera's errors vary slowly over the image: on RedKitchen, depth is up to 1.5 % too large
# on one side and too small on the other. Where two views share a third of an image, depth alone
# moves the result by 6 to 9 cm, and colour alone by 1 to 2 cm.
DENSE = JointOptions(geometric_weight=0.05)

# Maximum number of renderings of the target per view, and motion (translation in median depths plus
# rotation in radians) that triggers a new one.
_RENDERS, _RERENDER_DISTANCE = 6, 0.01
# An estimate that moved by less since the last rendering has converged: 1 mm at 1 m.
_CONVERGED = 0.001
# Minimum overlap of a converged registration.
_MIN_OVERLAP = 0.1

# After a larger motion, newly rendered views are aligned from the coarsest level; after a smaller
# one at the finest level only.
_FAR = 0.05

# Tolerated displacement of classes: as a fraction of the image's width while the estimate may be
# far from the solution, and in pixels afterwards.
_FAR_WINDOW = 0.025
_NEAR_WINDOW_PIXELS = 2


class FineRegistration:
    """Registers two submaps from a start close to the solution; see Registrar."""

    method = "fine (dense)"

    def __init__(
        self, options: RegistrationOptions | None = None, renderer: ViewRenderer | None = None
    ) -> None:
        self.options = options or RegistrationOptions()
        self.renderer = renderer or ViewRenderer()

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; the default start is the identity."""
        return self.refine(
            target, source, np.eye(4) if T_target_source is None else T_target_source
        )

    def refine(
        self,
        target: Submap,
        source: Submap,
        start: Array,
        views: list[int] | None = None,
    ) -> RegistrationResult:
        """Refine T_target_source from a start close to the solution.

        Args:
            views: indices of the source keyframes to compare; chosen by overlap by default.
        """
        before = self.renderer.renders
        if views is None:
            views = views_of_overlap(target, source, start, self.options.views)
        sources = [self._source_view(source, index) for index in views]
        sources = [view for view in sources if view.median_depth_m > 0]
        if not sources:
            return failed(self.method, "no view of the one shows what the other saw", start)
        estimate, targets = self._estimate(target, source, sources, start)
        pairs = self._pairs(sources, targets, far=False)
        check = self._check(sources, targets, estimate.T_target_source)
        renders = self.renderer.renders - before
        return self._result(estimate, check, renders, pairs)

    def _source_view(self, source: Submap, index: int) -> SourceView:
        keyframe = source.keyframes[index]
        view = self.renderer.render(
            source, self.renderer.camera_of(keyframe), keyframe.T_map_camera
        )
        solid = view.depth_m[view.depth_m > 0]
        median_depth_m = float(np.median(solid)) if solid.size else 0.0
        return SourceView(view, keyframe.T_map_camera, median_depth_m)

    def _target_views(
        self, target: Submap, sources: list[SourceView], T: Array
    ) -> list[TargetView]:
        """Render the target at the poses of the source views, for T_target_source [4, 4]."""
        targets = []
        for source in sources:
            T_target_view = T @ source.T_source_camera
            view = self.renderer.render(target, source.view.camera, T_target_view)
            levels = pyramid(view.level, DENSE.levels)
            model = [model_level(level) for level in levels]
            targets.append(TargetView(view, T_target_view, model))
        return targets

    def _estimate(
        self, target: Submap, source: Submap, sources: list[SourceView], start: Array
    ) -> tuple[Estimate, list[TargetView]]:
        """Joint Gauss-Newton; the target is rendered again if the views have moved far."""
        estimate = Estimate(start.copy())
        rendered_at, targets, far = start, self._target_views(target, sources, start), True
        for round_ in range(_RENDERS):
            pairs = self._pairs(sources, targets, far)
            estimate = align(pairs, estimate, DENSE, finest_only=not far)
            motion = _largest_motion(sources, rendered_at, estimate.T_target_source)
            near = motion <= _RERENDER_DISTANCE
            # Steps may oscillate around the solution by less than the required accuracy.
            oscillates = motion <= _CONVERGED
            converged = estimate.converged or (oscillates and estimate.pixels.sum() >= MIN_PIXELS)
            # Far from the last rendering, the estimate is not verified.
            estimate = replace(estimate, converged=bool(converged and near))
            if estimate.converged or round_ + 1 == _RENDERS:
                break
            far = motion > _FAR
            rendered_at = estimate.T_target_source
            targets = self._target_views(target, sources, rendered_at)
        return estimate, targets

    def _pairs(self, sources: list[SourceView], targets: list[TargetView], far: bool) -> list[Pair]:
        pairs = []
        for source, target in zip(sources, targets, strict=True):
            level = source.view.level
            window = _NEAR_WINDOW_PIXELS
            if far:
                window = max(window, round(_FAR_WINDOW * level.camera.width))
            mask = mismatched_classes(source.view.class_ids, target.view.class_ids, window)
            if mask is not None:
                depth_m = level.depth_m.masked_fill(torch.from_numpy(mask), 0.0)
                level = replace(level, depth_m=depth_m)
            frame = pyramid(level, DENSE.levels)
            T_model_target = se3.inverse(target.T_target_view)
            pairs.append(Pair(target.model, frame, T_model_target, source.T_source_camera))
        return pairs

    def _check(
        self, sources: list[SourceView], targets: list[TargetView], T: Array
    ) -> AlignmentCheck:
        total = AlignmentCheck()
        for source, target in zip(sources, targets, strict=True):
            T_view_frame = se3.inverse(target.T_target_view) @ T @ source.T_source_camera
            total += compare(target.view, source.view, T_view_frame)
        return total

    def _result(
        self, estimate: Estimate, check: AlignmentCheck, renders: int, pairs: list[Pair]
    ) -> RegistrationResult:
        reason = ""
        if check.overlap < _MIN_OVERLAP:
            reason = f"the submaps share only {100 * check.overlap:.0f} % of the views"
        elif not estimate.converged:
            reason = "the optimiser did not converge"
        return RegistrationResult(
            T_target_source=estimate.T_target_source,
            converged=not reason,
            inliers=check.inliers,
            residual=estimate.scales,
            overlap=check.overlap,
            class_agreement=check.class_agreement,
            information=clustered_information(pairs, estimate, DENSE),
            iterations=estimate.iterations,
            renders=renders,
            method=self.method,
            reason=reason,
        )


def _largest_motion(sources: list[SourceView], T_before: Array, T_after: Array) -> float:
    """Largest motion of a view: translation in median depths plus rotation in radians."""
    motions = []
    for view in sources:
        T = se3.inverse(T_before @ view.T_source_camera) @ T_after @ view.T_source_camera
        metres = float(np.linalg.norm(T[:3, 3]))
        motions.append(metres / view.median_depth_m + float(se3.rotation_angle_rad(T[:3, :3])))
    return max(motions)


def mismatched_classes(
    source: NDArray[np.int32] | None, target: NDArray[np.int32] | None, window: int
) -> NDArray[np.bool_] | None:
    """Mask [H, W] of the pixels whose class does not occur in the other view within a window.

    Void matches everything. None if a view has no classes.
    """
    if source is None or target is None:
        return None
    kernel = np.ones((2 * window + 1, 2 * window + 1), np.uint8)
    agree = (source == 0) | (target == 0)
    for class_id in np.unique(source[~agree]):
        near = cv2.dilate((target == class_id).astype(np.uint8), kernel) > 0
        agree |= (source == class_id) & near
    return ~agree
