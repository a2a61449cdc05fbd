"""Semantic-guided registration (G-III.B): coarse from similar keyframes, then fine by rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.slam.loops.registration.coarse import CoarseRegistration, register_coarse
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.quality import check_alignment
from toolkit.slam.loops.registration.result import RegistrationResult
from toolkit.slam.loops.registration.views import ViewRenderer, views_of_overlap
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]


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
