"""Registration of submaps of RedKitchen: success rate, error and time.

SEMSPLAT_DATA=DATA python -m benchmarks.loops.registration
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.loops.registration_pairs import Pair, kitchen_pairs
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import Table, Target, target_table
from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.coarse import CoarseRegistration
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import RegistrationResult
from toolkit.slam.loops.registration.sgr import SemanticGuidedRegistration
from toolkit.slam.loops.verification import rejection_reason

SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
# Of the ground truth itself, in metres and degrees.
TRUTH_ERROR = 0.02, 1.0
HALF = 0.5  # overlap that separates easy from hard pairs
COLUMNS = (
    *("overlap >= 50 %", "30-50 %", "median cm", "median deg", "converged", "converged, wrong"),
    *("passed, wrong", "median s", "of it coarse", "renders", "chi2 / 6"),
)
DESCRIPTION = """\
Submaps are parts of RedKitchen, mapped at their true poses with default settings and described by
the default encoder; the coordinate frame of each is arbitrary, and no frame of the recording is in
both submaps of a pair. The ground truth is itself accurate to 2 cm and 1 degree only; the table of
targets is without and with that error.

Rows with "(start)" begin at the ground truth displaced by up to 0.5 m and 30 degrees, the same for
all; the others have no initial estimate. Success is an error below 5 cm and 2 degrees; the first
two columns are by the overlap of the submaps. "Converged, wrong" counts failures reported as
converged, "passed, wrong" those of them that the verification of loops accepts. Methods take turns
on each pair, so that times are comparable."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure registration."""

    pairs: int = 30
    """Maximum number of pairs of submaps."""
    seed: int = 0
    """Seed of pairs, starts and maps."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class Timed:
    """A registration, and the seconds of its coarse and its fine stage."""

    result: RegistrationResult
    first_s: float
    second_s: float


class Methods:
    """Every method on one pair; the coarse stage runs once, and its time counts for all."""

    def __init__(self, pair: Pair, seed: int) -> None:
        self._pair, self._seed = pair, seed
        self._coarse: dict[tuple[str, bool], tuple[CoarseRegistration, float]] = {}
        default = RegistrationOptions()
        self.rows: dict[str, Callable[[], Timed]] = {
            "coarse, Z = I (G-5)": lambda: self._first(replace(default, offsets="none")),
            "coarse": lambda: self._first(default),
            "fine (start)": self._fine,
            "SGR": self._both,
            "SGR (start)": lambda: self._both(started=True),
        }

    def _first(self, options: RegistrationOptions) -> Timed:
        sgr = SemanticGuidedRegistration(options, seed=self._seed)
        coarse, first_s = self._coarse_stage(sgr, started=False)
        return Timed(coarse.result, first_s, 0.0)

    def _fine(self) -> Timed:
        pair, begin = self._pair, time.perf_counter()
        result = FineRegistration().register(pair.target, pair.source, pair.start)
        return Timed(result, 0.0, time.perf_counter() - begin)

    def _both(self, started: bool = False) -> Timed:
        sgr = SemanticGuidedRegistration(seed=self._seed)
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


@dataclass(frozen=True)
class Trial:
    """The result of one method on one pair.

    Attributes:
        objection: why a loop's verification refuses the result; empty where it does not.
        first_s, seconds: of the coarse stage, and of all.
        chi2: squared error by the result's own information, six expected.
    """

    method: str
    overlap: float
    error_m: float
    error_deg: float
    converged: bool
    objection: str
    first_s: float
    seconds: float
    renders: int
    chi2: float

    def within(self, truth_error_m: float = 0.0, truth_error_deg: float = 0.0) -> bool:
        """Whether it is a success: within the bounds plus the error of the ground truth."""
        near = self.error_m < SUCCESS_M + truth_error_m
        return near and self.error_deg < SUCCESS_DEG + truth_error_deg


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
        overlap=pair.overlap,
        error_m=float(np.linalg.norm(error[:3, 3])),
        error_deg=float(np.rad2deg(se3.rotation_angle_rad(error[:3, :3]))),
        converged=result.converged,
        objection=rejection_reason(result),
        first_s=timed.first_s,
        seconds=timed.first_s + timed.second_s,
        renders=result.renders,
        chi2=float(tangent @ result.information @ tangent),
    )


def tables(trials: Sequence[Trial]) -> tuple[Table, ...]:
    """A row for each method, and targets."""
    by_method: dict[str, list[Trial]] = {}
    for trial in trials:
        by_method.setdefault(trial.method, []).append(trial)
    rows = tuple((name, *_cells(own)) for name, own in by_method.items())
    return Table(("method", *COLUMNS), rows), target_table(targets(by_method["SGR"]))


def targets(trials: Sequence[Trial]) -> list[Target]:
    """What the default registration should reach, without and with the ground truth's error."""
    found = []
    beyond = ", beyond {:g} cm and {:g} degree of truth error"
    for error in ((0.0, 0.0), TRUTH_ERROR):
        suffix = beyond.format(100 * error[0], error[1]) if any(error) else ""
        for name, half, least in (("50 % overlap and more", True, 95), ("30-50 %", False, 80)):
            chosen = [t.within(*error) for t in trials if (t.overlap >= HALF) == half]
            share = 100.0 * float(np.mean(chosen)) if chosen else None
            found.append(Target(f"SGR, success at {name}, %{suffix}", share, at_least=least))
        passed = sum(not t.within(*error) and not t.objection for t in trials)
        found.append(Target(f"SGR, wrong but verified{suffix}", passed, at_most=0))
    return found


def _cells(trials: Sequence[Trial]) -> list[str]:
    def median(name: str) -> float:
        return float(np.median([getattr(trial, name) for trial in trials]))

    wrong = [trial for trial in trials if trial.converged and not trial.within()]
    return [
        _rate([trial for trial in trials if trial.overlap >= HALF]),
        _rate([trial for trial in trials if trial.overlap < HALF]),
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


def _rate(trials: Sequence[Trial]) -> str:
    """Successes of tries."""
    good = sum(trial.within() for trial in trials)
    return f"{good}/{len(trials)} ({100 * good / len(trials):.0f} %)" if trials else "-"


def main() -> None:
    """Measure every method on every pair."""
    options = tyro.cli(Options)
    header = current_header([options.seed])
    trials: list[Trial] = []
    for pair in tqdm(kitchen_pairs(options.pairs, options.seed), file=sys.stderr):
        methods = Methods(pair, options.seed).rows
        trials += [judged(name, pair, register()) for name, register in methods.items()]
    title = "Registration of submaps: redkitchen"
    found = tables(trials)
    publish(Results("registration-redkitchen", title, DESCRIPTION, header, found), options.out)


if __name__ == "__main__":
    main()
