"""The methods that `benchmarks.loops.registration` compares, each with its time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.loops.cloud_registration import CloudRegistration
from benchmarks.loops.registration_pairs import Pair
from benchmarks.loops.two_way_registration import TwoWayRegistration
from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.registration.coarse import CoarseRegistration
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.first_order_fine import FirstOrderFineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import Registrar, RegistrationResult
from toolkit.slam.loops.registration.sgr import SemanticGuidedRegistration
from toolkit.slam.loops.registration.views import ViewRenderer


@dataclass(frozen=True)
class Timed:
    """A registration and its stages' seconds."""

    result: RegistrationResult
    first_s: float
    second_s: float


class Methods:
    """Every method on one pair; the coarse stage runs once, and its time counts for all."""

    MAIN = (
        *("coarse, Z = I (G-5)", "coarse", "fine (start)", "SGR", "SGR (start)"),
        *("coarse, then two-way", "two-way (start)", "FPFH, RANSAC, ICP", "ICP (start)"),
        *("SGR, first-order fine (G-6)", "SGR, first-order fine, no feature term"),
    )

    def __init__(self, pair: Pair, seed: int) -> None:
        self._pair, self._seed = pair, seed
        self._coarse: dict[tuple[str, bool], tuple[CoarseRegistration, float]] = {}
        self.rows: dict[str, Callable[[], Timed]] = {
            "coarse, Z = I (G-5)": lambda: self._first(RegistrationOptions(offsets="none")),
            "coarse": lambda: self._first(RegistrationOptions()),
            "fine (start)": lambda: self._alone(FineRegistration(renderer=self._renderer()), True),
            "SGR": lambda: self._both(self._sgr(RegistrationOptions())),
            "SGR (start)": lambda: self._both(self._sgr(RegistrationOptions()), started=True),
            "coarse, then two-way": lambda: self._both(self._two_way()),
            "two-way (start)": lambda: self._alone(self._two_way_fine(), True),
            "FPFH, RANSAC, ICP": lambda: self._alone(self._clouds()),
            "ICP (start)": lambda: self._alone(self._clouds(), started=True),
            "SGR, first-order fine (G-6)": lambda: self._both(
                self._sgr(RegistrationOptions(optimiser="first-order"))
            ),
            "SGR, first-order fine, no feature term": lambda: self._both(
                self._sgr(RegistrationOptions(optimiser="first-order", feature=0.0))
            ),
        }

    def _renderer(self) -> ViewRenderer:
        return ViewRenderer(semantics=self._pair.semantics)

    def _sgr(self, options: RegistrationOptions) -> SemanticGuidedRegistration:
        renderer, refiner = self._renderer(), None
        if options.optimiser == "first-order":
            refiner = FirstOrderFineRegistration(options, renderer, ViewDescriber(BuiltinEncoder()))
        return SemanticGuidedRegistration(options, renderer, refiner, self._seed)

    def _two_way(self) -> SemanticGuidedRegistration:
        refiner = self._two_way_fine()
        return SemanticGuidedRegistration(None, refiner.renderer, refiner, self._seed)

    def _two_way_fine(self) -> TwoWayRegistration:
        return TwoWayRegistration(FineRegistration(renderer=self._renderer()))

    def _clouds(self) -> CloudRegistration:
        return CloudRegistration("ransac", "point-to-plane", self._renderer())

    def _first(self, options: RegistrationOptions) -> Timed:
        sgr = SemanticGuidedRegistration(options, seed=self._seed)
        coarse, first_s = self._coarse_stage(sgr, started=False)
        return Timed(coarse.result, first_s, 0.0)

    def _both(self, sgr: SemanticGuidedRegistration, started: bool = False) -> Timed:
        coarse, first_s = self._coarse_stage(sgr, started)
        begin = time.perf_counter()
        start = self._pair.start if started else None
        result = sgr.refined(self._pair.target, self._pair.source, coarse, start)
        return Timed(result, first_s, time.perf_counter() - begin)

    def _coarse_stage(
        self, sgr: SemanticGuidedRegistration, started: bool
    ) -> tuple[CoarseRegistration, float]:
        key = (sgr.options.offsets, started)
        if key not in self._coarse:
            begin = time.perf_counter()
            start = self._pair.start if started else None
            coarse = sgr.coarse(self._pair.target, self._pair.source, start)
            self._coarse[key] = coarse, time.perf_counter() - begin
        return self._coarse[key]

    def _alone(self, registrar: Registrar, started: bool = False) -> Timed:
        start = self._pair.start if started else None
        begin = time.perf_counter()
        result = registrar.register(self._pair.target, self._pair.source, start)
        return Timed(result, 0.0, time.perf_counter() - begin)
