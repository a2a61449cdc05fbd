"""Fine registration: views of the source against the target rendered from the same poses (G-6).

It works in one direction and changes neither map. The optimiser is a joint Gauss-Newton over
all views, which ignores pixels whose classes differ. The paper's own loss and optimiser are a
baseline, see `toolkit.baselines.first_order_fine`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.data import ModelLevel
from toolkit.alignment.joint import MIN_PIXELS, Estimate, Pair, align
from toolkit.alignment.levels import model_level, pyramid
from toolkit.geometry import se3
from toolkit.registration.options import FineOptions
from toolkit.registration.quality import AlignmentCheck, compare
from toolkit.registration.result import RegistrationResult, failed
from toolkit.registration.views import View, ViewRenderer, views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SourceView:
    """A rendered view of the source, its pose [4, 4], and the median depth of its surface (m)."""

    view: View
    T_source_camera: Array
    reach_m: float


@dataclass(frozen=True)
class TargetView:
    """The target rendered at the estimated pose [4, 4] of a view of the source."""

    view: View
    T_target_view: Array
    model: list[ModelLevel]


# An estimate that moved by less than this fraction of `rerender_distance` since the last rendering
# has converged: 1 mm at 1 m.
_AT_REST = 0.1

# After a larger motion (median depths plus radians), views rendered again are aligned from the
# coarsest level; after a smaller one at the finest level only.
_FAR = 0.05

# Classes may be displaced by this fraction of the image's width as long as the estimate may be far
# off, and by this number of pixels afterwards.
_FAR_WINDOW = 0.025
_NEAR_WINDOW_PIXELS = 2


class FineRegistration:
    """Registers two submaps from a start close to the solution; see Registrar."""

    method = "fine (dense)"

    def __init__(
        self, options: FineOptions | None = None, renderer: ViewRenderer | None = None
    ) -> None:
        self.options = options or FineOptions()
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
        sources = [self._source_view(source, place) for place in views]
        sources = [seen for seen in sources if seen.reach_m > 0]
        if not sources:
            return failed(self.method, "no view of the one shows what the other saw", start)
        estimate, targets = self._estimated(target, source, sources, start)
        check = self._checked(sources, targets, estimate.T_target_source)
        renders = self.renderer.renders - before
        return self._result(estimate, check, renders)

    def _source_view(self, source: Submap, place: int) -> SourceView:
        keyframe = source.keyframes[place]
        view = self.renderer.render(
            source, self.renderer.camera_of(keyframe), keyframe.T_map_camera
        )
        solid = view.depth_m[view.depth_m > 0]
        reach_m = float(np.median(solid)) if solid.size else 0.0
        return SourceView(view, keyframe.T_map_camera, reach_m)

    def _drawn(self, target: Submap, sources: list[SourceView], T: Array) -> list[TargetView]:
        drawn = []
        for seen in sources:
            T_target_view = T @ seen.T_source_camera
            view = self.renderer.render(target, seen.view.camera, T_target_view)
            levels = pyramid(view.level, self.options.dense.levels)
            model = [model_level(level) for level in levels]
            drawn.append(TargetView(view, T_target_view, model))
        return drawn

    def _estimated(
        self, target: Submap, source: Submap, sources: list[SourceView], start: Array
    ) -> tuple[Estimate, list[TargetView]]:
        """Joint Gauss-Newton; the target is rendered again if the views have moved far."""
        estimate = Estimate(start.copy())
        drawn_at, targets, far = start, self._drawn(target, sources, start), True
        for round_ in range(self.options.renders):
            pairs = self._pairs(sources, targets, far)
            estimate = align(pairs, estimate, self.options.dense, finest_only=not far)
            moved = _farthest(sources, drawn_at, estimate.T_target_source)
            near = moved <= self.options.rerender_distance
            # Steps may oscillate around the solution by less than the required accuracy.
            oscillates = moved <= _AT_REST * self.options.rerender_distance
            at_rest = estimate.converged or (oscillates and estimate.pixels.sum() >= MIN_PIXELS)
            # Far from the last rendering, the estimate is not verified.
            estimate = replace(estimate, converged=bool(at_rest and near))
            if estimate.converged or round_ + 1 == self.options.renders:
                break
            far = moved > _FAR
            drawn_at = estimate.T_target_source
            targets = self._drawn(target, sources, drawn_at)
        return estimate, targets

    def _pairs(self, sources: list[SourceView], targets: list[TargetView], far: bool) -> list[Pair]:
        pairs = []
        for seen, drawn in zip(sources, targets, strict=True):
            level = seen.view.level
            window = _NEAR_WINDOW_PIXELS
            if far:
                window = max(window, round(_FAR_WINDOW * level.camera.width))
            if self.options.semantic_gate:
                clash = classes_clash(seen.view.class_ids, drawn.view.class_ids, window)
                if clash is not None:
                    depth_m = level.depth_m.masked_fill(torch.from_numpy(clash), 0.0)
                    level = replace(level, depth_m=depth_m)
            frame = pyramid(level, self.options.dense.levels)
            T_model_target = se3.inverse(drawn.T_target_view)
            pairs.append(Pair(drawn.model, frame, T_model_target, seen.T_source_camera))
        return pairs

    def _checked(
        self, sources: list[SourceView], targets: list[TargetView], T: Array
    ) -> AlignmentCheck:
        total = AlignmentCheck()
        for seen, drawn in zip(sources, targets, strict=True):
            T_view_frame = se3.inverse(drawn.T_target_view) @ T @ seen.T_source_camera
            total += compare(drawn.view, seen.view, T_view_frame)
        return total

    def _result(
        self, estimate: Estimate, check: AlignmentCheck, renders: int
    ) -> RegistrationResult:
        reason = ""
        if check.overlap < self.options.min_overlap:
            reason = f"the submaps share only {100 * check.overlap:.0f} % of the views"
        elif not estimate.converged:
            reason = "the optimiser did not come to rest"
        return RegistrationResult(
            T_target_source=estimate.T_target_source,
            converged=not reason,
            inliers=check.inliers,
            residual=estimate.scales,
            overlap=check.overlap,
            class_agreement=check.class_agreement,
            information=estimate.information / self.options.redundancy,
            iterations=estimate.iterations,
            renders=renders,
            method=self.method,
            reason=reason,
        )


def _farthest(sources: list[SourceView], T_before: Array, T_after: Array) -> float:
    """Largest motion of a view: translation in median depths plus rotation in radians."""
    motions = []
    for seen in sources:
        T = se3.inverse(T_before @ seen.T_source_camera) @ T_after @ seen.T_source_camera
        metres = float(np.linalg.norm(T[:3, 3]))
        motions.append(metres / seen.reach_m + float(se3.rotation_angle_rad(T[:3, :3])))
    return max(motions)


def classes_clash(
    source: NDArray[np.int32] | None, target: NDArray[np.int32] | None, window: int
) -> NDArray[np.bool_] | None:
    """Pixels [H, W] whose class does not occur in the other view within a window around them.

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
