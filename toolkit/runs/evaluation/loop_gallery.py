"""The pairs of images of a report's loop gallery: accepted loops, and the nearest rejected ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.runs.evaluation.run_loops import accepted_edges

Record = dict[str, Any]

# Queries that are at most this many frames apart show the same.
_SAME_FRAMES = 5


@dataclass(frozen=True)
class LoopPair:
    """Two frames that were compared as a loop.

    Attributes:
        query, match: frame indices, the later one first.
        accepted: whether the pair led to an edge of the pose graph.
        reason: the measured values of an accepted pair, else why it was rejected.
        distance: distance of the descriptors; None if the pair was not found by descriptors.
    """

    query: int
    match: int
    accepted: bool
    reason: str
    distance: float | None = None


@dataclass(frozen=True)
class LoopPicture:
    """A pair and its images [H, W, 3] in [0, 1]."""

    pair: LoopPair
    query_rgb: NDArray[np.floating]
    match_rgb: NDArray[np.floating]


def gallery_pairs(records: Sequence[Record], count: int) -> list[LoopPair]:
    """Choose pairs of frames of the loop log.

    Args:
        records: records of loops.jsonl.
        count: maximum number of accepted and of rejected pairs.

    Returns:
        Accepted pairs, evenly spaced over the run, then rejected pairs with the smallest distance
        of descriptors. Frames of a loaded map (negative) are skipped.
    """
    records = [r for r in records if r.get("match", 0) >= 0]
    candidates = {(r["query"], r["match"]): r for r in records if r["kind"] == "candidate"}
    edges = {(r["query"], r["match"]): r for r in accepted_edges(records)}
    accepted = [
        LoopPair(*frames, True, _values(edge), _distance(candidates.get(frames)))
        for frames, edge in sorted(edges.items())
    ]
    chosen = np.linspace(0, len(accepted) - 1, min(count, len(accepted))).round().astype(int)
    rejected = [
        LoopPair(*frames, False, _reason(record, records), _distance(record))
        for frames, record in sorted(candidates.items(), key=lambda item: item[1]["distance"])
        if frames not in edges
    ]
    return [*(accepted[i] for i in chosen), *_different(rejected, count)]


def results_of(candidate: Record, later: Sequence[Record]) -> list[Record]:
    """Return the later records of the log about a candidate's frames or submaps."""
    submaps = {candidate["query_submap"], candidate["match_submap"]}
    frames = (candidate["query"], candidate["match"])
    if len(submaps) == 1:
        same_frames = [r for r in later if (r.get("query"), r.get("match")) == frames]
        return [r for r in same_frames if r["kind"] in ("within", "consistency")]
    same_submaps = [r for r in later if {r.get("first"), r.get("second")} == submaps]
    return [
        r
        for r in same_submaps
        if r["kind"] in ("between", "consistency", "retracted")
        or (r["kind"] in ("verified", "images") and (r["query"], r["match"]) == frames)
    ]


def _different(pairs: Sequence[LoopPair], count: int) -> list[LoopPair]:
    """Return the first pairs of which no two have nearly the same query."""
    chosen: list[LoopPair] = []
    for pair in pairs:
        if len(chosen) == count:
            break
        if all(abs(pair.query - other.query) > _SAME_FRAMES for other in chosen):
            chosen.append(pair)
    return chosen


def _distance(candidate: Record | None) -> float | None:
    return None if candidate is None else float(candidate["distance"])


def _values(edge: Record) -> str:
    parts = [f"{edge['matches']} matches"] if edge.get("matches") is not None else []
    if edge.get("apart_m") is not None:
        parts.append(f"cameras {edge['apart_m']:.2f} m apart")
    return ", ".join(parts)


def _reason(candidate: Record, records: Sequence[Record]) -> str:
    """Return the last reason for rejecting a candidate."""
    if not candidate["accepted"]:
        return str(candidate["reason"])
    position = next(i for i, record in enumerate(records) if record is candidate)
    rejections = [r for r in results_of(candidate, records[position + 1 :]) if not r["accepted"]]
    return str(rejections[-1]["reason"]) if rejections else "not verified: others were preferred"
