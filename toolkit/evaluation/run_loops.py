"""Loop metrics of a run, from its loop log and the ground-truth poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.datasets.base import Dataset
from toolkit.datasets.faults import fault_tolerant
from toolkit.datasets.prefetch import prefetched
from toolkit.evaluation.loop_poses import edge_errors, edge_metrics
from toolkit.evaluation.loops import (
    LoopTruthOptions,
    TrueViews,
    loop_convention,
    loop_definitions,
    loop_metrics,
)
from toolkit.evaluation.metrics import Metrics
from toolkit.evaluation.options import TruthErrorOptions
from toolkit.geometry.frustum import far_depth_m, observed_points

# Number of observed points per frame for computing overlap.
_POINTS = 300


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
        dataset: the dataset with ground truth; every frame is read once.
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
    views = true_views(dataset)
    verified = [
        (r["query"], r["match"])
        for r in accepted_edges(records)
        if r["apart_m"] < options.max_distance_m
    ]
    candidates = [
        (r["query"], r["match"]) for r in records if r["kind"] == "candidate" and r["accepted"]
    ]
    assert views.timestamps_s is not None
    errors = edge_errors(posed_edges(records), views.T_world_camera, views.timestamps_s, own)
    definitions = loop_definitions(options)
    return {
        "searched": len(set(searched)),
        "edges": edge_metrics(errors, own),
        "verified": loop_metrics(views, searched, verified, options),
        "suspected": loop_metrics(views, searched, candidates, options),
        "conventions": {name: loop_convention(each) for name, each in definitions.items()},
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


def true_views(dataset: Dataset) -> TrueViews:
    """Collect ground-truth poses and observed points of all frames of a dataset.

    A frame that cannot be read has no pose.
    """
    truth = dataset.ground_truth
    assert truth is not None
    poses, points, far_m, times_s = [], [], [], []
    for frame in prefetched(fault_tolerant(dataset), range(len(dataset))):
        T_world_camera = None if frame.fault else truth.at(frame.timestamp_s)
        poses.append(np.full((4, 4), np.nan) if T_world_camera is None else T_world_camera)
        points.append(observed_points(frame.camera, frame.depth_m, _POINTS))
        far_m.append(far_depth_m(frame.depth_m))
        times_s.append(frame.timestamp_s)
    return TrueViews(
        dataset.camera, np.array(poses), np.array(points), np.array(far_m), np.array(times_s)
    )
