"""Place recognition on real recordings and rooms: descriptors, and the verified edges of runs.

    python -m benchmarks.place_recognition

The first table describes every fifth frame. The second one runs the system with a search at each
keyframe and compares every verified edge with the ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.loops import area_under_curve, described, location
from benchmarks.recordings import RECORDINGS
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.runs import finished_slam
from benchmarks.tables import Table
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.loops import LoopTruthOptions, true_intervals
from toolkit.runs.evaluation.run_loops import accepted_edges, true_views
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.builtin import BuiltinEncoder, ColourHistogramEncoder
from toolkit.semantics.features.encoder import Encoder
from toolkit.semantics.features.keypoints import detect_keypoints, similarity_votes
from toolkit.semantics.features.vlad import VladEncoder

Array = NDArray[np.float64]

MAX_ERROR_M, MAX_ERROR_DEG = 0.05, 2.0
_SIZES = {"hololens": (270, 180)}
_EVERY = 5
_VOTING_KEYPOINTS = 600

TEXT = """\
Descriptors: every fifth frame is compared with the earlier ones beyond the gap of the detector, at
true poses. Recall@k is the share of frames with a true loop of which one of the k nearest is true;
the area under the curve (AUC) is how often a true pair is nearer than another. fr1_rpy has no true
loop by the detector's gap; there, views at least one second apart count (any length of path). The
vocabulary of VLAD is learned from synthetic rooms of other seeds. Votes count the similar keypoints
of two images; they need no vocabulary, but their time grows with the number of keyframes. DINOv2
needs weights that were not available.

Edges: complete runs without the final refinement, with a search at each keyframe. A searched
keyframe with a true loop counts as found if it led to a verified edge, applied or not, within 5 cm
and 2 degrees of the ground truth, plus the ground truth's own error: 2 cm and 1 degree for
RedKitchen and HoloLens, none for the room."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure place recognition."""

    sequences: tyro.conf.Positional[tuple[str, ...]] = (
        "redkitchen",
        "hololens",
        "fr1_rpy",
        "room",
        "room-noise",
        "ring-small",
    )
    """Sequences of the first table."""
    runs: tuple[str, ...] = ("redkitchen", "hololens", "room")
    """Sequences of the second table."""
    part: Literal["descriptors", "edges", "both"] = "both"
    """Which table; the results hold both."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure both tables."""
    options = tyro.cli(Options)
    header = current_header([0])
    tables = []
    if options.part != "edges":
        rows = [row for name in options.sequences for row in descriptor_rows(name)]
        columns = ("sequence", "descriptor", "recall@1 %", "recall@5 %", "AUC", "queries")
        tables.append(Table(columns, tuple(rows), "Descriptors"))
    if options.part != "descriptors":
        counts = {name: edge_counts(name) for name in options.runs}
        counts["pooled"] = tuple(np.sum(list(counts.values()), axis=0))
        edge_columns = (
            *("sequence", "with a true loop", "found", "found %"),
            *("edges", "correct", "beyond 5 cm or 2 deg"),
        )
        table_rows = tuple(
            (name, str(true), str(found), f"{100 * found / max(true, 1):.0f}", *map(str, rest))
            for name, (true, found, *rest) in counts.items()
        )
        tables.append(Table(edge_columns, table_rows, "Edges"))
    results = Results("place_recognition", "Place recognition", TEXT, header, tuple(tables))
    if options.part == "both":
        publish(results, options.out)
    else:
        print(results.markdown())


def opened(name: str) -> Dataset:
    """A sequence at the size of its runs."""
    return open_dataset(*location(name, 0), size_of(name))


def size_of(name: str) -> tuple[int, int] | None:
    """Image size of a sequence; None for its own."""
    recording = RECORDINGS.get(name)
    return _SIZES.get(name, None if recording is None else recording.image_size)


def descriptor_rows(name: str) -> Iterator[tuple[str, ...]]:
    """A row for each descriptor."""
    dataset = opened(name)
    views = true_views(dataset)
    frames = np.arange(0, len(views), _EVERY)
    gap = LoopTruthOptions() if name != "fr1_rpy" else LoopTruthOptions(min_gap_m=0.0)
    anywhere = LoopTruthOptions(max_distance_m=np.inf, min_overlap=0.0, min_gap_m=gap.min_gap_m)
    pairs = np.ix_(frames, frames)
    truth, beyond = true_intervals(views, gap)[pairs], true_intervals(views, anywhere)[pairs]
    for label, similarity in similarities(dataset, frames):
        first, five = recall(similarity, truth, beyond, 1), recall(similarity, truth, beyond, 5)
        auc = area_under_curve(-similarity[beyond], truth[beyond])
        queries = str(int(truth.any(axis=1).sum()))
        yield name, label, f"{100 * first:.0f}", f"{100 * five:.0f}", f"{auc:.3f}", queries
    yield name, "DINOv2", "n/a", "n/a", "n/a", "n/a"


def similarities(dataset: Dataset, frames: NDArray[np.integer]) -> Iterator[tuple[str, Array]]:
    """Similarity [K, K] of every two frames by each descriptor."""
    encoders: dict[str, Encoder] = {
        "VLAD": VladEncoder(),
        "built-in": BuiltinEncoder(),
        "colour histograms": ColourHistogramEncoder(),
    }
    for label, encoder in encoders.items():
        rows = described(dataset, encoder)
        yield label, (rows @ rows.T).astype(np.float64)
    greys = [
        cv2.cvtColor((255.0 * dataset[int(i)].rgb).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
        for i in frames
    ]
    votes = similarity_votes([detect_keypoints(grey, _VOTING_KEYPOINTS) for grey in greys])
    yield "votes of keypoints", votes.astype(np.float64)


def recall(
    similarity: Array, truth: NDArray[np.bool_], beyond: NDArray[np.bool_], count: int
) -> float:
    """Share of the frames with a true loop of which one of the nearest is true."""
    hits = []
    for query in np.flatnonzero(truth.any(axis=1)):
        earlier = np.flatnonzero(beyond[query])
        nearest = earlier[np.argsort(-similarity[query, earlier], kind="stable")[:count]]
        hits.append(truth[query, nearest].any())
    return float(np.mean(hits)) if hits else float("nan")


def edge_counts(name: str) -> tuple[int, ...]:
    """Searched keyframes with a true loop, those found, edges, correct ones, and those beyond the
    bounds without the ground truth's own error.
    """
    kind, place = location(name, 0)
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": kind, "path": str(place)},
            "image_size": size_of(name),
            "mapping": {"final_iterations": 0},
            "loops": {"candidates": {"search_every": 1}},
        },
    )
    dataset = opened(name)
    with finished_slam(settings, dataset) as run:
        records = run.records
    views = true_views(dataset)
    truth = true_intervals(views)
    searched = {r["query"] for r in records if r["kind"] == "search"}
    with_loop = {query for query in searched if truth[query].any()}
    own_m, own_deg = (0.02, 1.0) if name in RECORDINGS else (0.0, 0.0)
    errors = {
        (r["query"], r["match"]): edge_error(r, views.T_world_camera)
        for r in accepted_edges(records)
    }
    correct = {
        pair
        for pair, (metres, degrees) in errors.items()
        if metres <= MAX_ERROR_M + own_m and degrees <= MAX_ERROR_DEG + own_deg
    }
    beyond = [m > MAX_ERROR_M or deg > MAX_ERROR_DEG for m, deg in errors.values()]
    found = with_loop & {query for query, _ in correct}
    return len(with_loop), len(found), len(errors), len(correct), sum(beyond)


def edge_error(record: dict, T_world_camera: Array) -> tuple[float, float]:
    """Distance (m) and angle (degrees) of an edge from the ground truth."""
    measured = np.array(record["T_match_query"]).reshape(4, 4)
    true = se3.inverse(T_world_camera[record["match"]]) @ T_world_camera[record["query"]]
    error = se3.inverse(true) @ measured
    angle_rad = se3.rotation_angle_rad(error[:3, :3])
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(angle_rad))


if __name__ == "__main__":
    main()
