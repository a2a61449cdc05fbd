"""Fine registration: the source's views against the target drawn from the same places (G-6).

One direction only, and both maps stay as they are. The default optimiser is of second order:
one joint Gauss-Newton over all views, where pixels of different classes have no say. The
papers' own loss and optimiser are in `fine_first_order`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.data import ModelLevel
from toolkit.alignment.joint import (
    MIN_PIXELS,
    Estimate,
    JointOptions,
    Pair,
    align,
)
from toolkit.alignment.levels import model_level, pyramid
from toolkit.features.sources import ViewDescriber
from toolkit.geometry import se3
from toolkit.registration.fine_first_order import (
    FirstOrderFineOptions,
    descend,
)
from toolkit.registration.quality import AlignmentCheck, compare
from toolkit.registration.result import RegistrationResult, failed
from toolkit.registration.view_features import ViewFeatures
from toolkit.registration.views import View, ViewDrawer, views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FineOptions:
    """Values of the fine stage.

    Attributes:
        optimiser: "dense", or "first-order" for the papers'.
        views: most views of the source (G: k).
        renders: how often the target is drawn from all of them, dense alone.
        rerender_distance: draw again when a view moved by more than this share of its median
            depth (translation) or this angle in radians.
        least_overlap: a result on less common ground has not converged.
        semantic_gate: leave out pixels whose classes differ.
        redundancy: so many residuals count as one in the information matrix. Pixels and views
            show the same Gaussians, and the error of a fit is that of two maps, not of pixels:
            counted one by one, squared errors were 200 to 1100 times the expected ones in
            synthetic rooms, with sensor noise and without.
    """

    optimiser: Literal["dense", "first-order"] = "dense"
    views: int = 10
    renders: int = 6
    rerender_distance: float = 0.01
    least_overlap: float = 0.1
    semantic_gate: bool = True
    redundancy: float = 500.0
    dense: JointOptions = field(default_factory=JointOptions)
    first_order: FirstOrderFineOptions = field(default_factory=FirstOrderFineOptions)


@dataclass(frozen=True)
class _SourceView:
    """A view of the source, drawn once."""

    view: View
    T_source_camera: Array
    reach_m: float


@dataclass(frozen=True)
class _TargetView:
    """The target as drawn where a view of the source was thought to be."""

    view: View
    T_target_view: Array
    model: list[ModelLevel]


# An answer that moved by less than this share of the distance that asks for a new drawing, since
# the last one, has come to rest: 1 mm at 1 m.
_AT_REST = 0.1

# Views that moved farther than this (median depths plus radians) are aligned from the coarsest
# level again once they are drawn anew; others need the finest alone.
_FAR = 0.05

# A class agrees with one that lies within this share of the image's width in a drawing that may
# be far off, and within so many pixels in one that is near.
_FAR_WINDOW = 0.025
_NEAR_WINDOW_PIXELS = 2

_ROUNDS = 8  # of the residual scales' fixed point


class FineRegistration:
    """Registers submaps that nearly fit; a Registrar that needs a start.

    Args:
        describer: of views, for the feature term of the first-order optimiser (G-6); None
            leaves the term out.
    """

    def __init__(
        self,
        options: FineOptions | None = None,
        drawer: ViewDrawer | None = None,
        describer: ViewDescriber | None = None,
    ) -> None:
        self.options = options or FineOptions()
        self.drawer = drawer or ViewDrawer()
        self.view_features = None
        if describer is not None:
            self.view_features = ViewFeatures(describer, self.drawer.semantics)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; without a start it begins at the identity."""
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
        """T_target_source from a start near it.

        Args:
            views: places of the source's keyframes to look from; chosen by overlap without.
        """
        before = self.drawer.renders
        if views is None:
            views = views_of_overlap(target, source, start, self.options.views)
        sources = [self._source_view(source, place) for place in views]
        sources = [seen for seen in sources if seen.reach_m > 0]
        if not sources:
            return failed(self._method, "no view of the one shows what the other saw", start)
        if self.options.optimiser == "first-order":
            estimate, targets = self._descended(target, source, sources, start)
        else:
            estimate, targets = self._aligned(target, sources, start)
        check = self._checked(sources, targets, estimate.T_target_source)
        renders = self.drawer.renders - before
        return self._result(estimate, check, renders)

    @property
    def _method(self) -> str:
        return f"fine ({self.options.optimiser})"

    def _source_view(self, source: Submap, place: int) -> _SourceView:
        keyframe = source.keyframes[place]
        view = self.drawer.draw(source, self.drawer.camera_of(keyframe), keyframe.T_map_camera)
        solid = view.depth_m[view.depth_m > 0]
        reach_m = float(np.median(solid)) if solid.size else 0.0
        return _SourceView(view, keyframe.T_map_camera, reach_m)

    def _drawn(self, target: Submap, sources: list[_SourceView], T: Array) -> list[_TargetView]:
        drawn = []
        for seen in sources:
            T_target_view = T @ seen.T_source_camera
            view = self.drawer.draw(target, seen.view.camera, T_target_view)
            levels = pyramid(view.level, self.options.dense.levels)
            model = [model_level(level) for level in levels]
            drawn.append(_TargetView(view, T_target_view, model))
        return drawn

    def _aligned(
        self, target: Submap, sources: list[_SourceView], start: Array
    ) -> tuple[Estimate, list[_TargetView]]:
        """Joint Gauss-Newton; the target is drawn again where the views have moved far."""
        estimate = Estimate(start.copy())
        drawn_at, targets, far = start, self._drawn(target, sources, start), True
        for round_ in range(self.options.renders):
            pairs = self._pairs(sources, targets, far)
            estimate = align(pairs, estimate, self.options.dense, finest_only=not far)
            moved = _farthest(sources, drawn_at, estimate.T_target_source)
            near = moved <= self.options.rerender_distance
            # Steps may swing about an answer, by less than anyone asks of it, and never be small.
            swings = moved <= _AT_REST * self.options.rerender_distance
            at_rest = estimate.converged or (swings and estimate.pixels.sum() >= MIN_PIXELS)
            # Far from the last drawing, an answer was never seen to be right.
            estimate = replace(estimate, converged=bool(at_rest and near))
            if estimate.converged or round_ + 1 == self.options.renders:
                break
            far = moved > _FAR
            drawn_at = estimate.T_target_source
            targets = self._drawn(target, sources, drawn_at)
        return estimate, targets

    def _pairs(
        self, sources: list[_SourceView], targets: list[_TargetView], far: bool
    ) -> list[Pair]:
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

    def _descended(
        self, target: Submap, source: Submap, sources: list[_SourceView], start: Array
    ) -> tuple[Estimate, list[_TargetView]]:
        """The papers' optimiser, then one linearisation at its answer."""
        cameras = [seen.view.camera for seen in sources]
        T_source_camera = [seen.T_source_camera for seen in sources]
        found = descend(
            (target.gaussians, source.gaussians),
            (cameras, T_source_camera),
            start,
            self.options.first_order,
            self.drawer.backend_name,
            self.view_features,
        )
        self.drawer.renders += found.renders
        targets = self._drawn(target, sources, found.T_target_source)
        judged = self._judged(self._pairs(sources, targets, far=False), found.T_target_source)
        return replace(judged, iterations=found.iterations, converged=found.converged), targets

    def _judged(self, pairs: list[Pair], T_target_source: Array) -> Estimate:
        """ResidualScales and information at a motion that stays as it is."""
        still = replace(self.options.dense, iterations=1, exposure=False)
        estimate = Estimate(T_target_source)
        for _ in range(_ROUNDS):
            moved = align(pairs, estimate, still, finest_only=True)
            estimate = replace(moved, T_target_source=T_target_source)
        return estimate

    def _checked(
        self, sources: list[_SourceView], targets: list[_TargetView], T: Array
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
        if check.overlap < self.options.least_overlap:
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
            method=self._method,
            reason=reason,
        )


def _farthest(sources: list[_SourceView], T_before: Array, T_after: Array) -> float:
    """The largest motion of a view, translation in median depths plus rotation in radians."""
    motions = []
    for seen in sources:
        T = se3.inverse(T_before @ seen.T_source_camera) @ T_after @ seen.T_source_camera
        metres = float(np.linalg.norm(T[:3, 3]))
        motions.append(metres / seen.reach_m + float(se3.rotation_angle_rad(T[:3, :3])))
    return max(motions)


def classes_clash(
    source: NDArray[np.int32] | None, target: NDArray[np.int32] | None, window: int
) -> NDArray[np.bool_] | None:
    """Pixels [H, W] whose class the other view does not show within a window around them.

    Void on either side clashes with nothing. None where a view has no classes.
    """
    if source is None or target is None:
        return None
    kernel = np.ones((2 * window + 1, 2 * window + 1), np.uint8)
    agree = (source == 0) | (target == 0)
    for class_id in np.unique(source[~agree]):
        near = cv2.dilate((target == class_id).astype(np.uint8), kernel) > 0
        agree |= (source == class_id) & near
    return ~agree
