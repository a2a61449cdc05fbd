"""Refine the map of a finished run: register overlapping submaps, and optimise every submap.

The same tasks run in this process or on a cluster, with identical results. Submaps pass from
storage to the tasks; the driver sees poses and numbers only.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, replace
from typing import Any

from toolkit.io import storage
from toolkit.runs.batch.refining.anchors import (
    Anchors,
    Pair,
    chosen_pairs,
    corrected_anchors,
    possible_pairs,
)
from toolkit.runs.batch.refining.assembly import Assembled, AssemblyTask, assemble, store_decoder
from toolkit.runs.batch.refining.stored_map import open_stored_map
from toolkit.runs.batch.refining.tasks import (
    Extent,
    PairResult,
    PairTask,
    SubmapTask,
    Tasks,
    Work,
    measure_extent,
    measure_overlaps,
    refine_submap,
    register_submap_pair,
)
from toolkit.runs.batch.refining.trajectory import moved_frames
from toolkit.runs.new_folder import NewFolder

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Refined:
    """The result of a refinement.

    Attributes:
        submaps: number of submaps.
        pairs: number of registered pairs.
        verified: number of registrations that passed verification.
        largest_m: largest translation of a submap, metres; 0 if the registrations agree with the
            poses of the run.
        gaussians: number of Gaussians.
    """

    submaps: int
    pairs: int
    verified: int
    largest_m: float
    gaussians: int


def refine_map(
    place: str, out: str, tasks: Tasks, threads: int = 1, iterations: int | None = None
) -> Refined:
    """Refine the map of a finished run, and write it as a run folder.

    Args:
        place: run folder, a path or a URL.
        out: run folder to write, new or empty.
        tasks: executes the tasks.
        threads: number of threads of every task.
        iterations: optimisation steps per keyframe; by default as at the end of the run.

    Raises:
        ToolkitError: there is no finished run, its map cannot be refined, or `out` is in use.
    """
    source, frames = open_stored_map(place)
    rounds = source.settings.mapping.final_iterations if iterations is None else iterations
    folder = NewFolder(out, "refine", (place, out, threads, rounds))
    again = folder.begin()
    try:
        work = Work(source, out, threads, rounds)
        storage.remove_folder(work.scratch)
        work = replace(work, source=store_decoder(source, out))
        refined = _refine(work, frames, tasks)
    except BaseException:
        # Half a map is of no use. In a folder of an earlier attempt there may be other files.
        if not again:
            storage.remove_folder(out)
        raise
    storage.remove_folder(work.scratch)
    folder.complete()
    return refined


def _refine(work: Work, frames: dict[str, Any], tasks: Tasks) -> Refined:
    """Execute all tasks, and write all files."""
    source = work.source
    numbers = sorted(source.anchors)
    measured = tasks.map(measure_extent, [SubmapTask(work, n) for n in numbers])
    extents = dict(zip(numbers, measured, strict=True))
    pairs = _pairs(work, extents, tasks)
    _log.info("Registering %d pairs of %d submaps.", len(pairs), len(numbers))
    results = tasks.map(register_submap_pair, [PairTask(work, *pair) for pair in pairs])
    anchors = corrected_anchors(source.anchors, extents, results, source.settings.loops)
    _log.info("Refining %d submaps.", len(numbers))
    tasks.map(refine_submap, [SubmapTask(work, n) for n in numbers])
    (assembled,) = tasks.map(assemble, [AssemblyTask(work, dict(anchors.T_world_submap))])
    _write(work, frames, anchors, assembled, results)
    verified = sum(not result.reason for result in results)
    largest_m = anchors.largest_m / source.unit.per_metre
    return Refined(len(numbers), len(pairs), verified, largest_m, assembled.gaussians)


def _pairs(work: Work, extents: dict[int, Extent], tasks: Tasks) -> list[Pair]:
    """Choose the pairs of submaps to register."""
    others: dict[int, list[int]] = {}
    for first, second in possible_pairs(extents):
        others.setdefault(second, []).append(first)
    items = [SubmapTask(work, n, tuple(found)) for n, found in sorted(others.items())]
    overlaps: dict[Pair, float] = {}
    for item, measured in zip(items, tasks.map(measure_overlaps, items), strict=True):
        overlaps |= {(other, item.number): value for other, value in measured.items()}
    return chosen_pairs(overlaps, work.source.settings.loops.closing)


def _write(
    work: Work,
    frames: dict[str, Any],
    anchors: Anchors,
    assembled: Assembled,
    results: list[PairResult],
) -> None:
    """Write all files but the map."""
    source, out = work.source, work.out
    trajectory = storage.read_bytes(storage.join(source.place, "trajectory.txt"))
    T_old, T_new = (
        {number: source.unit.pose_in_metres(T) for number, T in poses.items()}
        for poses in (source.anchors, anchors.T_world_submap)
    )
    text, frames = moved_frames(trajectory, frames, T_old, T_new, assembled.exposures)
    storage.write_bytes(storage.join(out, "trajectory.txt"), text)
    storage.write_bytes(storage.join(out, "frames.json"), _json(frames))
    for name in ("taxonomy.yaml", "loops.jsonl", "saved_map.json"):
        if name in storage.names_in(source.place):
            content = storage.read_bytes(storage.join(source.place, name))
            storage.write_bytes(storage.join(out, name), content)
    _copy_separate_parts(source.place, out)
    storage.write_bytes(storage.join(out, "refine.json"), _json(_report(work, anchors, results)))
    # Last, so that a folder with settings is complete.
    config = storage.read_bytes(storage.join(source.place, "config.yaml"))
    storage.write_bytes(storage.join(out, "config.yaml"), config)


def _copy_separate_parts(place: str, out: str) -> None:
    """Copy the parts of the map beside the main part, which are not refined."""
    parts = storage.join(place, "parts")
    for number in storage.names_in(parts):
        for name in storage.names_in(storage.join(parts, number)):
            content = storage.read_bytes(storage.join(parts, number, name))
            storage.write_bytes(storage.join(out, "parts", number, name), content)


def _report(work: Work, anchors: Anchors, results: list[PairResult]) -> dict[str, Any]:
    return {
        "run": work.source.place,
        "threads": work.threads,
        "iterations": work.iterations,
        "largest_correction_m": anchors.largest_m / work.source.unit.per_metre,
        "pairs": [
            {
                "first": r.first,
                "second": r.second,
                **r.result.quality_values(),
                "used": (r.first, r.second) in anchors.used,
                "reason": r.reason,
            }
            for r in results
        ],
    }


def _json(content: dict[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()
