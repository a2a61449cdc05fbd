"""True loops of a run that led to no verified edge, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toolkit.runs.evaluation.loops import LoopTruthOptions, TrueMatches, TrueViews
from toolkit.runs.evaluation.run_loops import accepted_edges

Record = dict[str, Any]


@dataclass(frozen=True)
class MissedLoop:
    """A searched keyframe with a true loop, but without a verified edge.

    Attributes:
        query: frame index of the keyframe.
        match: the earlier frame that forms a true loop with it and shares most of its view.
        overlap: of their views, in [0, 1].
        reason: what ended the search or the verification.
    """

    query: int
    match: int
    overlap: float
    reason: str


def missed_loops(
    records: Sequence[Record], views: TrueViews, options: LoopTruthOptions | None = None
) -> list[MissedLoop]:
    """The missed loops of a run, by frame.

    Args:
        records: records of loops.jsonl.
        views: ground-truth poses and observed points. Of a long sequence, these are of some
            frames (`loop_views`), and so are the missed loops.
        options: definition of a true loop, with the gap of the detector.
    """
    truth = TrueMatches(views, options)
    searched = sorted({r["query"] for r in records if r["kind"] == "search"})
    found = {r["query"] for r in accepted_edges(records)}
    missed = []
    for query in searched:
        if query in found:
            continue
        matches = np.flatnonzero(truth.of(query))
        if not len(matches):
            continue
        overlaps = views.overlaps(query, matches)
        best = int(np.argmax(overlaps))
        reason = _reason(records, query)
        missed.append(MissedLoop(query, int(matches[best]), float(overlaps[best]), reason))
    return missed


def _reason(records: Sequence[Record], query: int) -> str:
    """The last result for a query, or that of its submaps, or of its best candidate."""
    own = [r for r in records if r.get("query") == query]
    results = [r for r in own if r["kind"] in ("within", "images", "verified") and r["reason"]]
    if results:
        last = results[-1]
        return f"with frame {last['match']}: {last['reason']}"
    candidates = [r for r in own if r["kind"] == "candidate"]
    if not candidates:
        return "no keyframe was considered"
    chosen = [r for r in candidates if r["accepted"]]
    if not chosen:
        return f"with frame {candidates[0]['match']}: {candidates[0]['reason']}"
    submaps = {(r["match_submap"], r["query_submap"]) for r in chosen}
    between = [
        r
        for r in records
        if r["kind"] in ("between", "consistency", "retracted")
        and (r.get("first"), r.get("second")) in submaps
        and r["reason"]
    ]
    if between:
        last = between[-1]
        return f"submaps {last['first']} and {last['second']}: {last['reason']}"
    frames = ", ".join(str(r["match"]) for r in chosen)
    return f"frames {frames}: images do not match"
