"""Semantic-guided registration (G-III.B): coarse from alike keyframes, then fine by rendering."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.registration.coarse import CoarseRegistration, register_coarse
from toolkit.registration.fine import FineRegistration
from toolkit.registration.options import CoarseOptions, FineOptions
from toolkit.registration.quality import check_alignment
from toolkit.registration.result import RegistrationResult
from toolkit.registration.views import ViewRenderer, views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SgrOptions:
    """Values of both stages; `seed` is of the coarse one's random choices."""

    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    fine: FineOptions = field(default_factory=FineOptions)
    seed: int = 0


class Refiner(Protocol):
    """The stage after the coarse one."""

    def refine(
        self, target: Submap, source: Submap, start: Array, views: list[int] | None = None
    ) -> RegistrationResult:
        """T_target_source from a start near it.

        Args:
            views: places of the source's keyframes to look from; the refiner's own choice
                without.
        """
        ...


class SemanticGuidedRegistration:
    """Registers two submaps, with or without a start; see Registrar.

    Args:
        refiner: second stage, a FineRegistration by default.
    """

    def __init__(
        self,
        options: SgrOptions | None = None,
        renderer: ViewRenderer | None = None,
        refiner: Refiner | None = None,
    ) -> None:
        self.options = options or SgrOptions()
        self.renderer = renderer or ViewRenderer()
        self.refiner = refiner or FineRegistration(self.options.fine, self.renderer)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar."""
        coarse = self.coarse(target, source, T_target_source)
        return self.refined(target, source, coarse, T_target_source)

    def coarse(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> CoarseRegistration:
        """The first stage alone."""
        # A generator of its own for every call: results do not depend on earlier ones.
        generator = np.random.default_rng(self.options.seed)
        return register_coarse(target, source, self.options.coarse, generator, T_target_source)

    def refined(
        self,
        target: Submap,
        source: Submap,
        coarse: CoarseRegistration,
        T_target_source: Array | None = None,
    ) -> RegistrationResult:
        """The second stage after the first.

        A coarse result that its pairs agree on comes before a given start, which may have
        drifted; without either there is nothing to refine.
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
        """The keyframes that the coarse stage rests on, and more that overlap."""
        count = self.options.fine.views
        more = views_of_overlap(target, source, start, count)
        return list(dict.fromkeys([*agreed, *more]))[:count]


class CoarseOnly:
    """The first stage as a Registrar, judged by looking: what it is worth by itself."""

    def __init__(
        self, options: SgrOptions | None = None, renderer: ViewRenderer | None = None
    ) -> None:
        self.renderer = renderer or ViewRenderer()
        self._sgr = SemanticGuidedRegistration(options, self.renderer)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar."""
        before = self.renderer.renders
        result = self._sgr.coarse(target, source, T_target_source).result
        if not result.converged:
            return result
        views = self._sgr.options.fine.views
        check = check_alignment(target, source, result.T_target_source, self.renderer, views)
        return replace(
            result,
            inliers=check.inliers,
            overlap=check.overlap,
            class_agreement=check.class_agreement,
            renders=self.renderer.renders - before,
        )
