"""A model of the cost of many runs and of the refinement of large maps, from measured times."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np

from benchmarks.tables import Table
from toolkit.base.geometry import se3
from toolkit.runs.batch.refining.anchors import corrected_anchors, possible_pairs
from toolkit.runs.batch.refining.tasks import Extent, PairResult
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.loops.registration.result import failed

SEQUENCES = (10, 100, 1000)
SUBMAPS = (100, 1000, 10_000)
CORES = (1, 2, 16, 128)
_FRAMES = 1000
# Tasks per submap, and the one that fuses all of them.
_PER_SUBMAP = ("measure_extent", "measure_overlaps", "refine_submap")
_PAIR, _FUSION = "register_submap_pair", "assemble"


@dataclass(frozen=True)
class CostInputs:
    """What was measured.

    Attributes:
        run_s: time of a run of `frames` frames, without the start of its process.
        frames: of that run.
        submaps, pairs: of the refined map.
        times_s: times of its tasks by function.
        submap_mb: mean size of a submap in storage, MB.
    """

    run_s: float
    frames: int
    submaps: int
    pairs: int
    times_s: Mapping[str, Sequence[float]]
    submap_mb: float


def cost_table(inputs: CostInputs) -> Table:
    """Predicted wall-clock hours by number of cores."""
    rows = []
    for count in SEQUENCES:
        total_s = count * inputs.run_s * _FRAMES / inputs.frames
        cells = [_hours(total_s / min(cores, count)) for cores in CORES]
        rows.append((f"{count} sequences of {_FRAMES} frames", *cells, "-"))
    for count in SUBMAPS:
        parallel_s, alone_s = refinement_seconds(inputs, count)
        cells = [_hours(parallel_s / cores + alone_s) for cores in CORES]
        size = f"{count * inputs.submap_mb / 1000.0:.1f}"
        rows.append((f"map of {count} submaps", *cells, size))
    titles = [f"{cores} core(s), h" for cores in CORES]
    return Table(("work", *titles, "submaps, GB"), tuple(rows), "Model")


def refinement_seconds(inputs: CostInputs, submaps: int) -> tuple[float, float]:
    """Seconds of all tasks that run side by side, and of the fusion, which one worker does."""
    scale = submaps / inputs.submaps
    parallel_s = scale * sum(sum(inputs.times_s.get(name, ())) for name in (*_PER_SUBMAP, _PAIR))
    return parallel_s, scale * fmean(inputs.times_s[_FUSION])


def driver_table() -> Table:
    """Measured times of the driver's work on made-up poses of submaps along a path."""
    rows = []
    for count in SUBMAPS:
        pairs_s = _pairs_s(count)
        rows.append((str(count), *(f"{t:.1f}" for t in (pairs_s, *_both(count)))))
    titles = ("submaps", "pairs of boxes, s", "poses that agree, s", "poses that move, s")
    return Table(titles, tuple(rows), "Driver", note="Two registrations per submap.")


def _both(count: int) -> tuple[float, float]:
    """Seconds of the pose graph if registrations agree with the poses, and if they do not."""
    return _anchors_s(count, 0.0), _anchors_s(count, 0.1)


def _hours(seconds: float) -> str:
    return f"{seconds / 3600.0:.2f}"


def _extents(count: int) -> dict[int, Extent]:
    corner = np.array([1.0, 0.0, 0.0])
    return {n: Extent(n * corner, n * corner + 3.0, 5.0, 2.0, 60) for n in range(count)}


def _pairs_s(count: int) -> float:
    extents = _extents(count)
    begin = time.monotonic()
    possible_pairs(extents)
    return time.monotonic() - begin


def _anchors_s(count: int, shift_m: float) -> float:
    """Seconds of the pose graph if the second half of the submaps is displaced."""
    poses = {n: se3.exp(np.array([n, 0.0, 0.0, 0.0, 0.0, 0.0])) for n in range(count)}
    shift = se3.exp(np.array([0.0, 0.0, shift_m, 0.0, 0.0, 0.0]))
    current = {n: shift @ T if n >= count // 2 else T for n, T in poses.items()}
    results = [
        PairResult(
            a,
            b,
            replace(
                failed("model", ""),
                T_target_source=se3.inverse(poses[a]) @ poses[b],
                information=1e8 * np.eye(6),
            ),
            "",
        )
        for step in (1, 2)
        for a, b in ((n, n + step) for n in range(count - step))
    ]
    begin = time.monotonic()
    corrected_anchors(current, _extents(count), results, LoopClosureOptions())
    return time.monotonic() - begin
