"""Registration of submaps: how often it succeeds, how far off, how long it takes.

    python -m benchmarks.registration --pairs 50 --rooms 0 1 2 3 --size 160 120
    SEMSPLAT_DATA=DATA python -m benchmarks.registration --rooms --kitchen

Submaps are pieces of a recording, mapped at their given poses with the default settings and
described by the default encoder, each told in a frame of its own that lies anywhere; no frame
is in two of them. A room is synthetic, with its true labels and 25 frames a submap or more; the
kitchen is 7-Scenes RedKitchen, whose truth is itself good to 1-2 cm only.

Rows with "(start)" are given the truth moved by up to 0.5 m and 30 degrees, the same for all;
others begin from nothing. Every row takes a pair before the next pair begins, so that what else
the machine does falls on all of them. Success is 5 cm and 2 degrees. "converged, wrong" are
results that are no success and say that they are; "passed, wrong" those of them that a loop's
verification lets through.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.machine import describe_machine
from benchmarks.registration_pairs import Pair, draw_pairs, kitchen, pool, room
from toolkit.baselines.clouds import CloudOptions, CloudRegistration
from toolkit.baselines.first_order_fine import FirstOrderFineRegistration
from toolkit.baselines.two_way import TwoWayRegistration
from toolkit.features.builtin import BuiltinEncoder
from toolkit.features.sources import ViewDescriber
from toolkit.geometry import se3
from toolkit.loops.verification import VerificationOptions, objection
from toolkit.registration.coarse import CoarseOptions, CoarseRegistration
from toolkit.registration.fine import FineOptions, FineRegistration, FirstOrderFineOptions
from toolkit.registration.result import Registrar, RegistrationResult
from toolkit.registration.sgr import SemanticGuidedRegistration, SgrOptions
from toolkit.registration.views import ViewDrawer

Array = NDArray[np.float64]

SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
HALF = 0.5  # overlap that parts the easy pairs from the hard ones


@dataclass(frozen=True)
class Options:
    """Measure registration."""

    pairs: int = 10
    """Most pairs of submaps of each recording."""
    rooms: tuple[int, ...] = (0,)
    """Seeds of synthetic rooms."""
    kitchen: bool = False
    """Take the real recording as well."""
    methods: tuple[str, ...] = ()
    """Rows to run; without it the main ones."""
    noise: bool = False
    """Give the synthetic rooms' camera a sensor's noise."""
    frames: int = 300
    """Frames of a synthetic room; 300 is all of its way."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images."""
    seed: int = 0
    """Of pairs, starts and maps."""
    trials: Path | None = None
    """Write a line of JSON for every result here."""


@dataclass(frozen=True)
class Trial:
    """What one method made of one pair.

    Attributes:
        first_s, second_s: seconds of the coarse stage and of what follows it.
        objection: why a loop's verification refuses the result; empty where it does not.
        chi2: squared error by the result's own information, six expected.
    """

    method: str
    pair: str
    overlap: float
    error_m: float
    error_deg: float
    converged: bool
    objection: str
    first_s: float
    second_s: float
    renders: int
    chi2: float
    motion: str

    @property
    def success(self) -> bool:
        """Within the bounds."""
        return self.error_m < SUCCESS_M and self.error_deg < SUCCESS_DEG

    @property
    def seconds(self) -> float:
        """Both stages."""
        return self.first_s + self.second_s


@dataclass(frozen=True)
class Timed:
    """A registration and its stages' seconds."""

    result: RegistrationResult
    first_s: float
    second_s: float


def main() -> None:
    """Print a table for the rooms and one for the kitchen."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    if options.rooms:
        named = "with sensor noise" if options.noise else "ideal images"
        show(f"synthetic rooms, {named}", room_pairs(options), options)
    if options.kitchen:
        generator = np.random.default_rng(options.seed)
        recording = kitchen(options.size)
        pieces = pool(recording, generator)
        pairs = draw_pairs(pieces, options.pairs, recording.semantics, generator, "kitchen")
        show("RedKitchen", pairs, options)


def room_pairs(options: Options) -> list[Pair]:
    """Pairs of every room."""
    pairs = []
    for seed in tqdm(options.rooms, desc="rooms", file=sys.stderr):
        generator = np.random.default_rng([seed, options.seed])
        recording = room(options.frames, options.size, seed, options.noise)
        pieces = pool(recording, generator)
        pairs += draw_pairs(pieces, options.pairs, recording.semantics, generator, f"room {seed}")
    return pairs


class Methods:
    """Every row, over one pair; its coarse stage is run once and its time told by all."""

    MAIN = (
        "coarse, Z = I (G-5)",
        "coarse",
        "fine (start)",
        "SGR",
        "SGR (start)",
        "coarse, then two-way",
        "two-way (start)",
        "FPFH, RANSAC, ICP",
        "ICP (start)",
    )

    def __init__(self, pair: Pair, seed: int) -> None:
        self._pair, self._seed = pair, seed
        self._coarse: dict[tuple[CoarseOptions, bool], tuple[CoarseRegistration, float]] = {}
        self.rows: dict[str, Callable[[], Timed]] = {
            "coarse, Z = I (G-5)": lambda: self._first(CoarseOptions(offsets="none")),
            "coarse": lambda: self._first(CoarseOptions()),
            "fine (start)": lambda: self._alone(FineRegistration(drawer=self._drawer()), True),
            "SGR": lambda: self._both(self._sgr(FineOptions())),
            "SGR (start)": lambda: self._both(self._sgr(FineOptions()), started=True),
            "coarse, then two-way": lambda: self._both(self._two_way()),
            "two-way (start)": lambda: self._alone(self._two_way_fine(), True),
            "FPFH, RANSAC, ICP": lambda: self._alone(self._clouds(CloudOptions())),
            "ICP (start)": lambda: self._alone(self._clouds(CloudOptions()), started=True),
            "SGR, classes ignored": lambda: self._both(self._sgr(FineOptions(semantic_gate=False))),
            "SGR, first-order fine (G-6)": lambda: self._both(
                self._sgr(FineOptions(optimiser="first-order"))
            ),
            "SGR, first-order fine, no feature term": lambda: self._both(
                self._sgr(_without_features())
            ),
            "FPFH, fast global, ICP": lambda: self._alone(self._clouds(CloudOptions("fast"))),
            "FPFH, RANSAC, coloured ICP": lambda: self._alone(
                self._clouds(CloudOptions(icp="coloured"))
            ),
        }

    def _drawer(self) -> ViewDrawer:
        return ViewDrawer(semantics=self._pair.semantics)

    def _sgr(self, fine: FineOptions) -> SemanticGuidedRegistration:
        options, drawer = SgrOptions(fine=fine, seed=self._seed), self._drawer()
        refiner = None
        if fine.optimiser == "first-order":
            refiner = FirstOrderFineRegistration(fine, drawer, ViewDescriber(BuiltinEncoder()))
        return SemanticGuidedRegistration(options, drawer, refiner)

    def _two_way(self) -> SemanticGuidedRegistration:
        refiner = self._two_way_fine()
        return SemanticGuidedRegistration(SgrOptions(seed=self._seed), refiner.drawer, refiner)

    def _two_way_fine(self) -> TwoWayRegistration:
        return TwoWayRegistration(FineRegistration(drawer=self._drawer()))

    def _clouds(self, options: CloudOptions) -> CloudRegistration:
        return CloudRegistration(options, self._drawer())

    def _first(self, options: CoarseOptions) -> Timed:
        sgr = SemanticGuidedRegistration(SgrOptions(options, seed=self._seed))
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
        key = (sgr.options.coarse, started)
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


def _without_features() -> FineOptions:
    """The papers' fine stage on colour and semantics alone."""
    return FineOptions("first-order", first_order=FirstOrderFineOptions(feature=0.0))


def judged(name: str, pair: Pair, timed: Timed) -> Trial:
    """A result beside the truth.

    Frames lie anywhere here. A run's lie at a submap's first camera, so errors and information
    are told there.
    """
    camera = pair.source.keyframes[0].T_map_camera
    error = se3.inverse(timed.result.T_target_source) @ pair.T_target_source
    error = se3.inverse(camera) @ error @ camera
    A = se3.adjoint(camera)
    result = replace(timed.result, information=A.T @ timed.result.information @ A)
    tangent = se3.log(error)
    return Trial(
        method=name,
        pair=pair.name,
        overlap=pair.overlap,
        error_m=float(np.linalg.norm(error[:3, 3])),
        error_deg=float(np.rad2deg(se3.rotation_angle_rad(error[:3, :3]))),
        converged=result.converged,
        objection=objection(result, VerificationOptions()),
        first_s=timed.first_s,
        second_s=timed.second_s,
        renders=result.renders,
        chi2=float(tangent @ result.information @ tangent),
        motion=hashlib.sha256(result.T_target_source.tobytes()).hexdigest()[:12],
    )


def show(title: str, pairs: list[Pair], options: Options) -> None:
    """Run every method on every pair and print a row a method."""
    names = options.methods or Methods.MAIN
    trials: list[Trial] = []
    for pair in tqdm(pairs, desc=title, file=sys.stderr):
        methods = Methods(pair, options.seed)
        for name in names:
            trials.append(judged(name, pair, methods.rows[name]()))
            if options.trials is not None:
                with options.trials.open("a") as file:
                    file.write(json.dumps(vars(trials[-1])) + "\n")
    print_table(title, pairs, trials)


COLUMNS = (
    "overlap >= 50 %",
    "30-50 %",
    "median cm",
    "median deg",
    "converged",
    "converged, wrong",
    "passed, wrong",
    "median s",
    "of it coarse",
    "renders",
    "chi2 / 6",
)


def print_table(title: str, pairs: list[Pair], trials: list[Trial]) -> None:
    """A row a method, then SGR's time against the two-way's."""
    motions = "".join(trial.motion for trial in trials).encode()
    print(f"\n### {title}: {len(pairs)} pairs, bits {hashlib.sha256(motions).hexdigest()[:12]}")
    print("\n| method | " + " | ".join(COLUMNS) + " |")
    print("|---|" + "---:|" * len(COLUMNS))
    by_method: dict[str, list[Trial]] = {}
    for trial in trials:
        by_method.setdefault(trial.method, []).append(trial)
    for name, own in by_method.items():
        print(f"| {name} | " + " | ".join(cells(own)) + " |")
    ratios("SGR", "coarse, then two-way", by_method)
    ratios("fine (start)", "two-way (start)", by_method)


def cells(trials: list[Trial]) -> list[str]:
    """Of one method."""

    def median(name: str) -> float:
        return float(np.median([getattr(trial, name) for trial in trials]))

    wrong = [trial for trial in trials if trial.converged and not trial.success]
    return [
        rate([trial for trial in trials if trial.overlap >= HALF]),
        rate([trial for trial in trials if trial.overlap < HALF]),
        f"{100 * median('error_m'):.2f}",
        f"{median('error_deg'):.3f}",
        f"{sum(trial.converged for trial in trials)}/{len(trials)}",
        f"{len(wrong)}",
        f"{sum(not trial.objection for trial in wrong)}",
        f"{median('seconds'):.2f}",
        f"{median('first_s'):.2f}",
        f"{median('renders'):.0f}",
        f"{median('chi2') / 6:.3g}",
    ]


def rate(trials: list[Trial]) -> str:
    """Successes of tries."""
    if not trials:
        return "-"
    good = sum(trial.success for trial in trials)
    return f"{good}/{len(trials)} ({100 * good / len(trials):.0f} %)"


def ratios(name: str, other: str, by_method: dict[str, list[Trial]]) -> None:
    """One method's time as a share of another's, on the same pairs."""
    if name not in by_method or other not in by_method:
        return
    mine, others = by_method[name], by_method[other]
    for what in ("seconds", "second_s"):
        a, b = (np.array([getattr(t, what) for t in trials]) for trials in (mine, others))
        stage = "in all" if what == "seconds" else "after the coarse stage"
        print(
            f"\n{name} / {other}, time {stage}: median of pairs {np.median(a / b):.2f}, "
            f"of the sums {a.sum() / b.sum():.2f}"
        )


if __name__ == "__main__":
    main()
