"""Results of `benchmarks.loops.registration`: errors against the truth, and their tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.loops.registration_methods import Timed
from benchmarks.loops.registration_pairs import Pair
from benchmarks.shared.tables import Table, Target, target_table
from toolkit.base.geometry import se3
from toolkit.slam.loops.verification import rejection_reason

SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
HALF = 0.5  # overlap that separates easy from hard pairs
COLUMNS = (
    *("overlap >= 50 %", "30-50 %", "median cm", "median deg", "converged", "converged, wrong"),
    *("passed, wrong", "median s", "of it coarse", "renders", "chi2 / 6"),
)


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


def tables(trials: Sequence[Trial], truth_error: tuple[float, float]) -> tuple[Table, ...]:
    """A row for each method, and targets."""
    by_method: dict[str, list[Trial]] = {}
    for trial in trials:
        by_method.setdefault(trial.method, []).append(trial)
    rows = tuple((name, *_cells(own)) for name, own in by_method.items())
    judged_table = target_table(targets(by_method["SGR"], truth_error))
    return Table(("method", *COLUMNS), rows), judged_table


def targets(trials: Sequence[Trial], truth_error: tuple[float, float]) -> list[Target]:
    """What the default registration should reach, without and with the ground truth's error."""
    found = []
    for error in dict.fromkeys([(0.0, 0.0), truth_error]):
        beyond = f", beyond {100 * error[0]:g} cm and {error[1]:g} degree of truth error"
        suffix = beyond if any(error) else ""
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
