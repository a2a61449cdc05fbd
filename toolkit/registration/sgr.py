"""Semantic-guided registration (G-III.B): coarse from alike keyframes, then fine by rendering."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.registration.coarse import CoarseOptions, register_coarse
from toolkit.registration.fine import FineOptions, FineRegistration
from toolkit.registration.fine_first_order import Encoder
from toolkit.registration.result import RegistrationResult
from toolkit.registration.views import ViewDrawer, views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SgrOptions:
    """Values of both stages; `seed` is of the coarse one's random choices."""

    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    fine: FineOptions = field(default_factory=FineOptions)
    seed: int = 0


class SemanticGuidedRegistration:
    """Registers submaps from nothing or from a start."""

    def __init__(
        self,
        options: SgrOptions | None = None,
        drawer: ViewDrawer | None = None,
        encoder: Encoder | None = None,
    ) -> None:
        self.options = options or SgrOptions()
        self.drawer = drawer or ViewDrawer()
        self._fine = FineRegistration(self.options.fine, self.drawer, encoder)

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar.

        A coarse result that its pairs agree on comes before a given start, which may have
        drifted; without either there is nothing to refine.
        """
        # A generator of its own for every call: results do not depend on earlier ones.
        generator = np.random.default_rng(self.options.seed)
        coarse = register_coarse(target, source, self.options.coarse, generator, T_target_source)
        if coarse.result.converged:
            start = coarse.result.T_target_source
        elif T_target_source is not None:
            start = T_target_source
        elif coarse.views:
            start = coarse.result.T_target_source
        else:
            return replace(coarse.result, method="sgr")
        views = self._views(target, source, start, coarse.views)
        fine = self._fine.refine(target, source, start, views)
        return replace(fine, method="sgr", iterations=fine.iterations + coarse.result.iterations)

    def _views(self, target: Submap, source: Submap, start: Array, agreed: list[int]) -> list[int]:
        """The keyframes that the coarse stage rests on, and more that overlap."""
        count = self.options.fine.views
        more = views_of_overlap(target, source, start, count)
        return list(dict.fromkeys([*agreed, *more]))[:count]
