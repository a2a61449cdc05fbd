"""Registration of submaps: success rate, error and time.

python -m benchmarks.registration --rooms 0 1 2 3 4 6 --pairs 34 --frames 150 --size 160 120
SEMSPLAT_DATA=DATA python -m benchmarks.registration --rooms --kitchen --pairs 30
SEMSPLAT_DATA=DATA python -m benchmarks.registration --rooms --kitchen --pairs 30 \\
    --trajectory RUN/trajectory.txt
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

from benchmarks.registration_pairs import Pair, draw_pairs, kitchen, pool, room
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table, Target, target_table
from toolkit.baselines.clouds import CloudRegistration
from toolkit.baselines.first_order_fine import FirstOrderFineRegistration
from toolkit.baselines.two_way import TwoWayRegistration
from toolkit.features.builtin import BuiltinEncoder
from toolkit.features.sources import ViewDescriber
from toolkit.geometry import se3
from toolkit.loops.options import VerificationOptions
from toolkit.loops.verification import rejection_reason
from toolkit.registration.coarse import CoarseRegistration
from toolkit.registration.fine import FineRegistration
from toolkit.registration.options import (
    CloudOptions,
    CoarseOptions,
    FineOptions,
    FirstOrderFineOptions,
)
from toolkit.registration.result import Registrar, RegistrationResult
from toolkit.registration.sgr import SemanticGuidedRegistration, SgrOptions
from toolkit.registration.views import ViewRenderer

Array = NDArray[np.float64]

SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
KITCHEN_ERROR = 0.02, 1.0  # of RedKitchen's ground truth itself, m and degrees
HALF = 0.5  # overlap that separates easy from hard pairs

DESCRIPTION = """\
Submaps are parts of a recording, mapped at their true poses with default settings and described by
the default encoder; the coordinate frame of each is arbitrary, and no frame of the recording is in
both submaps of a pair. Synthetic rooms have their true labels. The ground truth of RedKitchen is
itself accurate to 2 cm and 1 degree only; the table of targets is without and with that error.

Rows with "(start)" begin at the ground truth displaced by up to 0.5 m and 30 degrees, the same for
all; the others have no initial estimate. Success is an error below 5 cm and 2 degrees; the first
two columns are by the overlap of the submaps. "Converged, wrong" counts failures reported as
converged, "passed, wrong" those of them that the verification of loops accepts. Methods take turns
on each pair, so that times are comparable."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure registration."""

    pairs: int = 10
    """Maximum number of pairs of submaps of each recording."""
    rooms: tuple[int, ...] = (0,)
    """Seeds of synthetic rooms."""
    kitchen: bool = False
    """Include the real recording."""
    methods: tuple[str, ...] = ()
    """Rows to measure; the main ones by default. Others are printed, not written."""
    trajectory: Path | None = None
    """Poses of the real recording's frames to use instead of its ground truth (TUM format)."""
    noise: bool = False
    """Render the synthetic rooms with sensor noise."""
    frames: int = 300
    """Frames of a synthetic room; 300 is the whole path."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images in pixels."""
    seed: int = 0
    """Seed of pairs, starts and maps."""
    trials: Path | None = None
    """File for a line of JSON for each result."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class Trial:
    """The result of one method on one pair.

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
        return self.within()

    def within(self, truth_error_m: float = 0.0, truth_error_deg: float = 0.0) -> bool:
        """Within the bounds plus the error of the ground truth."""
        near = self.error_m < SUCCESS_M + truth_error_m
        return near and self.error_deg < SUCCESS_DEG + truth_error_deg

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
    """Measure the rooms and the kitchen."""
    options = tyro.cli(Options)
    if options.rooms:
        noise = "-noise" if options.noise else ""
        measure(f"registration-rooms{noise}", room_pairs, options)
    if options.kitchen:
        own = options.trajectory is not None
        name = "registration-redkitchen" + ("-trajectory" if own else "")
        measure(name, kitchen_pairs, options, (0.0, 0.0) if own else KITCHEN_ERROR)


def kitchen_pairs(options: Options) -> list[Pair]:
    """Pairs of the real recording."""
    generator = np.random.default_rng(options.seed)
    recording = kitchen(options.size, options.trajectory)
    pieces = pool(recording, generator)
    return draw_pairs(pieces, options.pairs, recording.semantics, generator, "kitchen")


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
    """Every method on one pair; the coarse stage runs once, and its time counts for all."""

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
            "fine (start)": lambda: self._alone(FineRegistration(renderer=self._renderer()), True),
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

    def _renderer(self) -> ViewRenderer:
        return ViewRenderer(semantics=self._pair.semantics)

    def _sgr(self, fine: FineOptions) -> SemanticGuidedRegistration:
        options, renderer = SgrOptions(fine=fine, seed=self._seed), self._renderer()
        refiner = None
        if fine.optimiser == "first-order":
            refiner = FirstOrderFineRegistration(fine, renderer, ViewDescriber(BuiltinEncoder()))
        return SemanticGuidedRegistration(options, renderer, refiner)

    def _two_way(self) -> SemanticGuidedRegistration:
        refiner = self._two_way_fine()
        return SemanticGuidedRegistration(SgrOptions(seed=self._seed), refiner.renderer, refiner)

    def _two_way_fine(self) -> TwoWayRegistration:
        return TwoWayRegistration(FineRegistration(renderer=self._renderer()))

    def _clouds(self, options: CloudOptions) -> CloudRegistration:
        return CloudRegistration(options, self._renderer())

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
    """A result compared with the ground truth.

    The coordinate frames of these submaps are arbitrary. In a run they are those of the first
    cameras, so errors and information are expressed there.
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
        objection=rejection_reason(result, VerificationOptions()),
        first_s=timed.first_s,
        second_s=timed.second_s,
        renders=result.renders,
        chi2=float(tangent @ result.information @ tangent),
        motion=hashlib.sha256(result.T_target_source.tobytes()).hexdigest()[:12],
    )


def measure(
    name: str,
    make_pairs: Callable[[Options], list[Pair]],
    options: Options,
    truth_error: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Run every method on every pair and write a row for each method.

    Args:
        truth_error: of the ground truth itself, in metres and degrees.
    """
    header = current_header([options.seed])
    names = options.methods or Methods.MAIN
    trials: list[Trial] = []
    for pair in tqdm(make_pairs(options), desc=name, file=sys.stderr):
        methods = Methods(pair, options.seed)
        for method in names:
            trials.append(judged(method, pair, methods.rows[method]()))
            if options.trials is not None:
                with options.trials.open("a") as file:
                    file.write(json.dumps(vars(trials[-1])) + "\n")
    title = f"Registration of submaps: {name.removeprefix('registration-')}"
    results = Results(name, title, DESCRIPTION, header, tables(trials, truth_error))
    if options.methods:
        print(results.markdown())
    else:
        publish(results, options.out)


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


def tables(trials: list[Trial], truth_error: tuple[float, float]) -> tuple[Table, ...]:
    """A row for each method, ratios of times, and targets."""
    by_method: dict[str, list[Trial]] = {}
    for trial in trials:
        by_method.setdefault(trial.method, []).append(trial)
    rows = tuple((name, *cells(own)) for name, own in by_method.items())
    notes = [
        ratio(by_method, "SGR", "coarse, then two-way"),
        ratio(by_method, "fine (start)", "two-way (start)"),
    ]
    found = [Table(("method", *COLUMNS), rows, note=" ".join(filter(None, notes)))]
    if "SGR" in by_method:
        found.append(target_table(targets(by_method["SGR"], truth_error)))
    return tuple(found)


def targets(trials: list[Trial], truth_error: tuple[float, float]) -> list[Target]:
    """What the default registration should reach, without and with the ground truth's error."""
    found = []
    for error in dict.fromkeys([(0.0, 0.0), truth_error]):
        beyond = f", beyond {100 * error[0]:g} cm and {error[1]:g} degree of truth error"
        suffix = beyond if any(error) else ""
        right = [t for t in trials if t.within(*error)]
        for name, half, least in (("50 % overlap and more", True, 95), ("30-50 %", False, 80)):
            chosen = [t for t in trials if (t.overlap >= HALF) == half]
            share = 100.0 * sum(t in right for t in chosen) / len(chosen) if chosen else None
            found.append(Target(f"SGR, success at {name}, %{suffix}", share, at_least=least))
        passed = [t for t in trials if t not in right and not t.objection]
        found.append(Target(f"SGR, wrong but verified{suffix}", len(passed), at_most=0))
    return found


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


def ratio(by_method: dict[str, list[Trial]], name: str, other: str) -> str:
    """One method's time relative to another's, as the median over pairs; empty without both."""
    if name not in by_method or other not in by_method:
        return ""
    medians = []
    for stage in ("seconds", "second_s"):
        a, b = (
            np.array([getattr(t, stage) for t in by_method[method]]) for method in (name, other)
        )
        medians.append(f"{np.median(a / b):.2f}")
    return (
        f"Time of {name} relative to {other}: {medians[0]}, after the coarse stage {medians[1]} "
        "(medians over pairs)."
    )


if __name__ == "__main__":
    main()
