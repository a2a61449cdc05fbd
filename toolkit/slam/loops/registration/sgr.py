"""Semantic-guided registration (G-III.B): coarse from similar keyframes, then fine by rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.coarse import CoarseRegistration, register_coarse
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.quality import check_alignment
from toolkit.slam.loops.registration.result import Registrar, RegistrationResult
from toolkit.slam.loops.registration.views import ViewRenderer, views_of_overlap
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]
# Maximum difference of two poses; well above the errors of correct registrations.
_MAX_DISTANCE_M, _MAX_ANGLE_RAD = 0.1, 0.07


class Refiner(Protocol):
    """The stage after coarse registration."""

    def refine(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> RegistrationResult:
        """Refine T_target_source from an initial pose close to the solution.

        Args:
            views: indices of the source keyframes to compare; chosen by the refiner by default.
        """
        ...


class SemanticGuidedRegistration:
    """Registers two submaps, with or without an initial pose; see Registrar.

    Args:
        refiner: second stage, a FineRegistration by default.
        seed: random seed of the coarse stage.
    """

    def __init__(
        self,
        options: RegistrationOptions | None = None,
        renderer: ViewRenderer | None = None,
        refiner: Refiner | None = None,
        seed: int = 0,
    ) -> None:
        self.options, self.seed = options or RegistrationOptions(), seed
        self.renderer = renderer or ViewRenderer()
        self.refiner = refiner or FineRegistration(self.options, self.renderer)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar."""
        coarse = self.coarse(target, source, T_target_source)
        return self.refined(target, source, coarse, T_target_source)

    def coarse(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> CoarseRegistration:
        """Run the coarse stage only."""
        # A new generator for every call, so that results do not depend on earlier calls.
        generator = np.random.default_rng(self.seed)
        return register_coarse(target, source, self.options, generator, T_target_source)

    def refined(
        self,
        target: Submap,
        source: Submap,
        coarse: CoarseRegistration,
        T_target_source: Array | None = None,
    ) -> RegistrationResult:
        """Run the fine stage after the coarse one.

        It starts at the coarse result if that has converged, because the given initial pose may
        have drifted; otherwise at the given pose. Without either it returns the coarse result.
        """
        if coarse.result.converged:
            start = coarse.result.T_target_source
        elif T_target_source is not None:
            start = T_target_source
        elif coarse.views:
            start = coarse.result.T_target_source
        else:
            return replace(coarse.result, method="sgr")
        views = self._views(target, source, start, coarse.views)
        fine = self.refiner.refine(target, source, start, views)
        method = "sgr" if isinstance(self.refiner, FineRegistration) else f"coarse, {fine.method}"
        return replace(fine, method=method, iterations=fine.iterations + coarse.result.iterations)

    def _views(self, target: Submap, source: Submap, start: Array, agreed: list[int]) -> list[int]:
        """The inlier keyframes of the coarse stage, then the keyframes with the largest overlap."""
        count = self.options.views
        more = views_of_overlap(target, source, start, count)
        return list(dict.fromkeys([*agreed, *more]))[:count]


class CoarseOnly:
    """Coarse registration without refinement, checked in rendered views; see Registrar."""

    def __init__(
        self,
        options: RegistrationOptions | None = None,
        renderer: ViewRenderer | None = None,
        seed: int = 0,
    ) -> None:
        self.renderer = renderer or ViewRenderer()
        self._sgr = SemanticGuidedRegistration(options, self.renderer, seed=seed)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar."""
        before = self.renderer.renders
        result = self._sgr.coarse(target, source, T_target_source).result
        if not result.converged:
            return result
        views = self._sgr.options.views
        check = check_alignment(target, source, result.T_target_source, self.renderer, views)
        return replace(
            result,
            inliers=check.inliers,
            overlap=check.overlap,
            class_agreement=check.class_agreement,
            renders=self.renderer.renders - before,
        )


class SecondOpinion:
    """Rejects registrations that a second registrar, without an initial pose, contradicts.

    If the second registrar does not converge, the result of the first one is returned.
    """

    def __init__(self, first: Registrar, second: Registrar) -> None:
        self._first, self._second = first, second

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; the result has not converged if the two methods disagree."""
        result = self._first.register(target, source, T_target_source)
        if not result.converged:
            return result
        other = self._second.register(target, source)
        renders = result.renders + other.renders
        if not other.converged:
            return replace(result, renders=renders)
        T = se3.inverse(result.T_target_source) @ other.T_target_source
        distance_m = float(np.linalg.norm(T[:3, 3]))
        angle_rad = float(se3.rotation_angle_rad(T[:3, :3]))
        if distance_m <= _MAX_DISTANCE_M and angle_rad <= _MAX_ANGLE_RAD:
            return replace(result, renders=renders)
        reason = f"{other.method} differs by {100 * distance_m:.0f} cm and {angle_rad:.2f} rad"
        return replace(result, converged=False, renders=renders, reason=reason)
