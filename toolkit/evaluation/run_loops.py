"""How well the loops of a run were found, from its log and the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.evaluation.loops import LoopTruthOptions, TrueViews, loop_metrics
from toolkit.evaluation.metrics import Metrics
from toolkit.geometry.frustum import far_depth_m, observed_points

# Observed points of a frame by which overlap is judged.
_POINTS = 300


def run_loop_metrics(
    records: Sequence[dict[str, Any]], dataset: Dataset, options: LoopTruthOptions
) -> Metrics:
    """Precision, recall and F1 of the loops that a run verified, and of those it suspected.

    A verified pair is farther apart than a loop may be where the same things were seen from
    elsewhere: its edge is as good, and the run knows the distance, so it claims no loop there.
    Nor does it where the edge that proved a pair was taken back, then or later.

    Args:
        records: the lines of loops.jsonl.
        dataset: with the truth; every frame is read once.
        options: with the detector's own gap.

    Returns:
        Flat figures; "_suspected" are by descriptors and landmarks alone. Empty where nothing
        was searched, or nothing is known.
    """
    # The frames of a saved map have negative indices, and no truth in this data set.
    records = [r for r in records if r.get("match", 0) >= 0]
    searched = [r["query"] for r in records if r["kind"] == "search"]
    if not searched or dataset.ground_truth is None:
        return {}
    views = true_views(dataset)
    verified = [
        (r["query"], r["match"])
        for r in _accepted(records)
        if r["apart_m"] < options.max_distance_m
    ]
    suspected = [
        (r["query"], r["match"]) for r in records if r["kind"] == "candidate" and r["accepted"]
    ]
    by_looks = loop_metrics(views, searched, suspected, options)
    return {
        **loop_metrics(views, searched, verified, options),
        **{
            f"{name.removesuffix('_percent')}_suspected_percent": value
            for name, value in by_looks.items()
            if name.endswith("_percent")
        },
    }


def _accepted(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Verdicts on pairs of frames that were taken for loops to the end."""
    taken_back = {_about(r) for r in records if r["kind"] in ("consistency", "retracted")}
    return [
        r
        for r in records
        if r["kind"] in ("within", "verified") and r["accepted"] and _about(r) not in taken_back
    ]


def _about(record: dict[str, Any]) -> tuple[str, int, int]:
    """What a verdict is about: an edge between two submaps, or between two keyframes of one."""
    if "first" in record:
        return "submaps", record["first"], record["second"]
    return "keyframes", record["match"], record["query"]


def true_views(dataset: Dataset) -> TrueViews:
    """Where each frame of a sequence was, and what it saw.

    Raises:
        DatasetError: a frame cannot be read.
    """
    truth = dataset.ground_truth
    assert truth is not None
    poses, points, far_m = [], [], []
    for frame in prefetched(dataset, range(len(dataset))):
        T_world_camera = truth.at(frame.timestamp_s)
        poses.append(np.full((4, 4), np.nan) if T_world_camera is None else T_world_camera)
        points.append(observed_points(frame.camera, frame.depth_m, _POINTS))
        far_m.append(far_depth_m(frame.depth_m))
    return TrueViews(dataset.camera, np.array(poses), np.array(points), np.array(far_m))
