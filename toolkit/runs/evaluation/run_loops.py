"""Loop metrics of a run, from its loop log and the ground-truth poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.base.geometry.frustum import far_depth_m, observed_points
from toolkit.base.keyframe import evenly_spaced
from toolkit.datasets.base import Dataset
from toolkit.datasets.faults import fault_tolerant
from toolkit.datasets.prefetch import prefetched
from toolkit.runs.evaluation.loop_poses import edge_errors, edge_metrics
from toolkit.runs.evaluation.loops import (
    LoopTruthOptions,
    TrueViews,
    loop_convention,
    loop_definitions,
    loop_metrics,
)
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.options import TruthErrorOptions

# Number of observed points per frame for computing overlap.
_POINTS = 300
# Longer sequences are evaluated on this number of evenly spaced frames and of searched keyframes,
# besides the frames of accepted loops: all pairs of frames would take hours.
_MAX_FRAMES, _SAMPLED, _SAMPLED_SEARCHES = 1500, 500, 300


def run_loop_metrics(
    records: Sequence[dict[str, Any]],
    dataset: Dataset,
    options: LoopTruthOptions,
    own: TruthErrorOptions | None = None,
) -> Metrics:
    """Compute the pose errors of a run's loop edges, then precision, recall and F1 of its loops.

    Pose errors are those of all accepted edges, including the relocalisations that started a
    submap. For precision and recall, verified pairs whose estimated camera distance exceeds the
    maximum of a loop do not count: their edge is valid, but they observe the same surfaces from
    different positions. Pairs whose edge was rejected or removed later do not count either.

    Args:
        records: records of loops.jsonl.
        dataset: the dataset with ground truth; every frame is read once, or some of a long one.
        options: definition of a true loop, with the gap of the detector.
        own: error of the ground truth itself; none by default.

    Returns:
        Metrics of the "edges" by pose, and by overlap of the views those of the "verified" pairs
        and of the pairs "suspected" by descriptors and landmarks, before verification. Empty if no
        loops were searched or there is no ground truth.
    """
    # Frames of a loaded map have negative indices and no ground truth in this dataset.
    records = [r for r in records if r.get("match", 0) >= 0]
    searched = [r["query"] for r in records if r["kind"] == "search"]
    if not searched or dataset.ground_truth is None:
        return {}
    verified = [
        (r["query"], r["match"])
        for r in accepted_edges(records)
        if r["apart_m"] < options.max_distance_m
    ]
    candidates = [
        (r["query"], r["match"]) for r in records if r["kind"] == "candidate" and r["accepted"]
    ]
    views = loop_views(dataset, records)
    compared = searched_frames(dataset, records)
    assert views.timestamps_s is not None
    errors = edge_errors(posed_edges(records), views.T_world_camera, views.timestamps_s, own)
    scores = loop_metrics(views, compared, verified, options)
    definitions = loop_definitions(options).items()
    return {
        "searched": len(set(searched)),
        "frames_compared": len(views.far_m),
        "edges": edge_metrics(errors, own),
        "verified": scores,
        "suspected": loop_metrics(views, compared, candidates, options),
        "conventions": {
            name: loop_convention(each) for name, each in definitions if name in scores
        },
    }


def accepted_edges(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the records of verified pairs of frames whose edge was not removed later."""
    removed = {_edge(r) for r in records if r["kind"] in ("consistency", "retracted")}
    kinds = ("within", "verified", "images")
    verified = [r for r in records if r["kind"] in kinds and r["accepted"]]
    return [r for r in verified if _edge(r) not in removed]


def posed_edges(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the accepted edges whose relative pose of two frames was recorded.

    In contrast to `accepted_edges`, relocalisations that connect a new submap are included.
    """
    removed = {_edge(r) for r in records if r["kind"] in ("consistency", "retracted")}
    found = [r for r in records if r["kind"] == "found" and _edge(r) not in removed]
    return [r for r in accepted_edges(records) + found if "T_match_query" in r]


def _edge(record: dict[str, Any]) -> tuple[str, int, int]:
    """Return the edge of a record, between two submaps or between two keyframes of one."""
    if "first" in record:
        return "submaps", record["first"], record["second"]
    return "keyframes", record["match"], record["query"]


def searched_frames(dataset: Dataset, records: Sequence[dict[str, Any]]) -> list[int]:
    """The keyframes at which loops were searched, or some of them in a long sequence."""
    searched = sorted({r["query"] for r in records if r["kind"] == "search"})
    return searched if len(dataset) <= _MAX_FRAMES else evenly_spaced(searched, _SAMPLED_SEARCHES)


def loop_views(dataset: Dataset, records: Sequence[dict[str, Any]]) -> TrueViews:
    """The views on which the loops of a run are evaluated: all, or some of a long sequence.

    Those are evenly spaced ones, the searched keyframes, and the frames of all accepted pairs, with
    the neighbours of those that have a pose.
    """
    count = len(dataset)
    if count <= _MAX_FRAMES:
        return true_views(dataset)
    frames = {*evenly_spaced(range(count), _SAMPLED), *searched_frames(dataset, records)}
    for record in records:
        if record.get("accepted") and record.get("match", -1) >= 0 and "query" in record:
            frames.update((record["query"], record["match"]))
    for edge in posed_edges(records):
        frames.update(edge[name] + step for name in ("query", "match") for step in (-1, 0, 1))
    return true_views(dataset, sorted(frame for frame in frames if 0 <= frame < count))


def true_views(dataset: Dataset, frames: Sequence[int] | None = None) -> TrueViews:
    """Collect ground-truth poses and observed points of a dataset.

    A frame that cannot be read has no pose.

    Args:
        frames: indices of the frames to read, in order; all by default.
    """
    truth = dataset.ground_truth
    assert truth is not None
    read = range(len(dataset)) if frames is None else frames
    T_world_camera = np.full((len(dataset), 4, 4), np.nan)
    times_s, rows = np.full(len(dataset), np.nan), np.full(len(dataset), -1)
    points, far_m = [], []
    for row, frame in enumerate(prefetched(fault_tolerant(dataset), read)):
        index = read[row]
        T = None if frame.fault else truth.at(frame.timestamp_s)
        if T is not None:
            T_world_camera[index] = T
        points.append(observed_points(frame.camera, frame.depth_m, _POINTS))
        far_m.append(far_depth_m(frame.depth_m))
        times_s[index], rows[index] = frame.timestamp_s, row
    return TrueViews(
        dataset.camera,
        T_world_camera,
        np.array(points),
        np.array(far_m),
        times_s,
        None if frames is None else rows,
    )
