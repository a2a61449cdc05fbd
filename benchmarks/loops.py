"""Loop detection: what each test contributes, and how encoders compare.

    python -m benchmarks.loops ring --image-size 160 120
    python -m benchmarks.loops twins --image-size 160 120 --seeds 5 --part rows \\
        --rows "and verification (default)"

The first table runs the system. The second one describes every fifth frame and searches at each of
them for earlier ones, at true poses, without a map.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import Report, ReportOptions, publish
from benchmarks.results_file import Results, current_header
from benchmarks.runs import CoveredLens, finished_slam
from benchmarks.tables import Metrics, Rows, Table, median_cell, table_of
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.loops import LoopScore, LoopTruthOptions, true_intervals
from toolkit.runs.evaluation.run_loops import true_views
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.builtin import BuiltinEncoder, ColourHistogramEncoder
from toolkit.semantics.features.dinov2 import Dinov2Encoder
from toolkit.semantics.features.encoder import Encoder
from toolkit.semantics.features.vlad import VladEncoder
from toolkit.slam.loops.candidates import CandidateFinder, DescribedKeyframe, LoopCandidate
from toolkit.slam.loops.options import CandidateOptions
from toolkit.slam.result import SlamResult

Array = NDArray[np.float64]
Values = dict[str, Any]

# Every registration is accepted.
_ACCEPT_ALL: Values = {
    "verify": False,
    "closing": {"min_visible": 0.0},
    "pose_graph": {"confidence": 1.0, "kernel": "none"},
}
# No class is ever seen as often, so that landmarks have no effect.
_NO_LANDMARKS: Values = {"landmarks": {"min_count": 10**9}}
# Candidates below the encoder's distance, ordered by landmarks.
_FIXED: Values = _ACCEPT_ALL | {"candidates": {"threshold": "fixed"}}
_PRINTED: Values = {"landmarks": {"weighting": "paper", "counted": "gaussians"}}
ROWS: dict[str, Values] = {
    "no loops": {"use": False},
    "descriptor alone": _FIXED | _NO_LANDMARKS,
    "and landmarks as printed (G-7)": _FIXED | _PRINTED,
    "and landmarks, linear": _FIXED | {"landmarks": {"weighting": "linear"}},
    "and landmarks, square root": _FIXED,
    "by rank, without verification": _ACCEPT_ALL,
    "and verification (default)": {},
}
COLUMNS = (
    "loops.suspected.overlap.precision_percent",
    "loops.suspected.overlap.recall_percent",
    "loops.suspected.overlap.f1_percent",
    "loops.verified.overlap.precision_percent",
    "loops.verified.overlap.recall_percent",
    "loops.verified.overlap.f1_percent",
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "frames.lost",
    "edges",
    "edges_false",
)

_EVERY = 5  # frames from keyframe to keyframe, for encoders


ROWS_TEXT = """\
Runs with these settings of loop closure, without the final refinement. Without verification, each
registration that converges enters the graph and stays: no bounds on it, no odometry to contradict
it, no robust kernel. "Suspected" metrics are those of the candidates of the search, the others
those of the loops held at the end. A false edge places an anchor more than half a metre from where
the ground truth has it."""
COVER_TEXT = " The lens is covered from frame {} to before frame {}: black images without depth."
ENCODERS_TEXT = """\
Every fifth frame is described and searched for among earlier ones, at true poses, without
landmarks. Thresholds belong to the encoder: its own, the adaptive one, and the one with the best
F1 on this very sequence, which flatters all alike. The area under the curve (AUC) needs none: how
often a true pair is nearer than a false one. The transformers have random weights."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure loop detection."""

    rooms: tyro.conf.Positional[tuple[str, ...]] = ("ring",)
    """Sequences: ring, ring-ideal, twins, redkitchen, fr1_rpy."""
    image_size: tuple[int, int] | None = None
    """Width and height in pixels; native if unset."""
    part: Literal["rows", "encoders", "both"] = "both"
    """Which table."""
    rows: tuple[str, ...] = ()
    """Rows of the first table; all by default. The results have no others."""
    cover: tuple[int, int] | None = None
    """First covered frame and the one after the last."""
    seeds: int = 1
    """Seeds 0, 1, ... of rooms and runs."""


def main() -> None:
    """Measure both tables of every sequence."""
    options = tyro.cli(Options)
    for name in options.rooms:
        if options.part != "encoders":
            measure_rows(options, name)
        if options.part != "rows":
            measure_encoders(options, name)


def measure_rows(options: Options, name: str) -> None:
    """What each test adds, by running the system."""
    covered = "" if options.cover is None else "-covered"
    size = "" if options.image_size is None else "-{}x{}".format(*options.image_size)
    report = Report(
        f"loops-{name}{covered}{size}",
        f"Loop detection on {name}{covered.replace('-', ', lens ')}{size.replace('-', ', ')}",
        ROWS_TEXT + (COVER_TEXT.format(*options.cover) if options.cover else ""),
        options,
        range(options.seeds),
    )
    common = {"sequence": name, "image_size": options.image_size, "cover": options.cover}
    jobs = {
        row: {"loops": loops, **common}
        for row, loops in ROWS.items()
        if row in (options.rows or tuple(ROWS))
    }
    found = report.measured(jobs, measure)
    tables = [table_of(COLUMNS, found)]
    if options.seeds > 1:
        tables.append(each_seed(found, options.seeds))
    report.write(*tables)


def each_seed(rows: Rows, seeds: int) -> Table:
    """Each sequence by itself: with several seeds, a room is rendered for each."""
    cells = [
        (f"{name}, seed {seed}", *(median_cell([runs[seed].get(c)]) for c in COLUMNS))
        for name, runs in rows.items()
        for seed in range(seeds)
    ]
    return Table(("", *COLUMNS), tuple(cells), "Each seed")


def measure(job: Values, seed: int) -> Metrics:
    """Metrics of one run with these settings of loop closure, without refinement.

    Args:
        job: its "instances" are the kind of masks, those of the folder being true ones.
    """
    name, size = job["sequence"], job["image_size"]
    kind, place = location(name, seed)
    masks = job.get("instances", "none")
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": kind, "path": str(place)},
            "image_size": size,
            "mapping": {"final_iterations": 0},
            "loops": job["loops"],
            "instances": {
                "kind": masks,
                "path": str(place / "instances") if masks == "folder" else None,
            },
            "seed": seed,
        },
    )
    dataset: Dataset = open_dataset(kind, place, settings.image_size)
    if job["cover"] is not None:
        dataset = CoveredLens(dataset, *job["cover"])
    with finished_slam(settings, dataset) as run:
        return run.metrics | {
            "edges": len(run.result.loops),
            "edges_false": false_edges(run.result, dataset),
        }


def location(name: str, seed: int) -> tuple[str, Path]:
    """Kind and folder of a recording or a synthetic sequence."""
    if name in RECORDINGS:
        return RECORDINGS[name].kind, RECORDINGS[name].path
    return "synthetic", room(name, seed)


def false_edges(result: SlamResult, dataset: Dataset) -> int:
    """Loop edges that the truth contradicts."""
    assert dataset.ground_truth is not None
    anchors = [
        dataset.ground_truth.at(dataset[submap.keyframe_indices[0]].timestamp_s)
        for submap in result.submaps
    ]
    count = 0
    for loop in result.loops:
        T_world_first, T_world_second = anchors[loop.first], anchors[loop.second]
        assert T_world_first is not None and T_world_second is not None
        error = loop.residual(T_world_first, T_world_second)
        count += bool(np.linalg.norm(error[:3]) > LoopTruthOptions().max_distance_m)
    return count


def measure_encoders(options: Options, name: str) -> None:
    """What each encoder finds by itself, at true poses."""
    header = current_header(
        [0],
        ("toolkit/semantics/features", "toolkit/slam/loops", "toolkit/runs/evaluation/loops.py"),
    )
    dataset = open_dataset(*location(name, 0), options.image_size)
    sequence = DescribedSequence.of(dataset)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for encoder_name, encoder in encoders(Path(place), 0):
            descriptors = described(dataset, encoder)
            auc = f"{sequence.area_under_curve(descriptors):.4f}"
            for threshold, candidates in searches(sequence, encoder, descriptors):
                score = sequence.score(candidates)
                shares = (score.precision, score.recall, score.f1)
                cells = [median_cell([None if s is None else 100.0 * s]) for s in shares]
                rows.append((encoder_name, auc, threshold, *cells))
    columns = ("encoder", "AUC", "threshold", "precision %", "recall %", "F1 %")
    table = Table(columns, tuple(rows))
    title = f"Image descriptors on {name}"
    publish(Results(f"encoders-{name}", title, ENCODERS_TEXT, header, (table,)), options.out)


@dataclass(frozen=True)
class DescribedSequence:
    """Every fifth frame of a sequence.

    Attributes:
        travelled_m: [K] length of the true path up to each.
        truth: [K, K] which pairs (later, earlier) are a true loop.
        beyond: [K, K] which are far enough apart along the path to be asked about.
    """

    travelled_m: Array
    truth: NDArray[np.bool_]
    beyond: NDArray[np.bool_]

    @classmethod
    def of(cls, dataset: Dataset) -> DescribedSequence:
        views = true_views(dataset)
        positions_m = views.T_world_camera[:, :3, 3]
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0, prepend=positions_m[:1]), axis=1)
        frames = np.arange(0, len(views), _EVERY)
        anywhere = LoopTruthOptions(max_distance_m=np.inf, min_overlap=0.0)
        pairs = np.ix_(frames, frames)
        return cls(
            np.cumsum(steps_m)[frames],
            true_intervals(views)[pairs],
            true_intervals(views, anywhere)[pairs],
        )

    def score(self, candidates: Sequence[LoopCandidate]) -> LoopScore:
        """Of accepted candidates, all keyframes having been searched at."""
        pairs = [(c.query // _EVERY, c.match // _EVERY) for c in candidates]
        correct = [pair for pair in pairs if self.truth[pair]]
        return LoopScore(
            accepted=len(pairs),
            correct=len(correct),
            with_loop=int(self.truth.any(axis=1).sum()),
            found=len({query for query, _ in correct}),
            true_intervals=int(self.truth.sum()),
            found_intervals=len(correct),
        )

    def area_under_curve(self, descriptors: NDArray[np.float32]) -> float:
        """How often a pair that is a true loop is nearer than one that is none."""
        distances = np.linalg.norm(descriptors[:, None] - descriptors[None], axis=2)
        return area_under_curve(distances[self.beyond], self.truth[self.beyond])


def area_under_curve(distances: Array, true: NDArray[np.bool_]) -> float:
    """How often one of the pairs [N] that are true is nearer than one that is not."""
    near, far = int(true.sum()), int((~true).sum())
    if not near or not far:
        return float("nan")
    ranks = rankdata(distances)[true].sum() - near * (near + 1) / 2
    return float(1.0 - ranks / (near * far))


def encoders(folder: Path, seed: int) -> Iterator[tuple[str, Encoder]]:
    """Encoders with their names; the transformer's random weights go through its real files."""
    yield "VLAD", VladEncoder()
    yield "built-in", BuiltinEncoder()
    yield "colour histograms", ColourHistogramEncoder()
    import transformers

    torch.manual_seed(seed)
    # The shape of DINOv2 ViT-S/14.
    config = transformers.Dinov2Config(
        hidden_size=384,
        num_hidden_layers=12,
        num_attention_heads=6,
        patch_size=14,
        image_size=518,
        mlp_ratio=4,
    )
    transformers.Dinov2Model(config).save_pretrained(folder)
    yield "random ViT-S/14, class token", Dinov2Encoder(folder, device="cpu")


def described(dataset: Dataset, encoder: Encoder) -> NDArray[np.float32]:
    """Descriptors [K, D] of every fifth frame."""
    rows = []
    for index in range(0, len(dataset), _EVERY):
        image = torch.from_numpy(dataset[index].rgb).permute(2, 0, 1)[None]
        with torch.no_grad():
            rows.append(encoder.describe(image)[0].numpy())
    return np.array(rows)


def searches(
    sequence: DescribedSequence, encoder: Encoder, descriptors: NDArray[np.float32]
) -> Iterator[tuple[str, list[LoopCandidate]]]:
    """A threshold, and the candidates that it accepts."""
    options = CandidateOptions(search_every=1, threshold="fixed")
    yield f"own, {encoder.threshold:.3f}", found(sequence, encoder, descriptors, options)
    adaptive = replace(options, threshold="adaptive")
    yield "adaptive", found(sequence, encoder, descriptors, adaptive)
    everything = replace(options, distance=2.0, kept=options.considered)
    every = found(sequence, encoder, descriptors, everything)

    def f1(threshold: float) -> float:
        return sequence.score(nearest(every, threshold, options.kept)).f1 or 0.0

    best = max(np.unique([c.distance for c in every if c.distance]) + 1e-9, key=f1)
    yield f"best, {best:.3f}", nearest(every, best, options.kept)


def found(
    sequence: DescribedSequence,
    encoder: Encoder,
    descriptors: NDArray[np.float32],
    options: CandidateOptions,
) -> list[LoopCandidate]:
    """Accepted candidates of the search at every keyframe, by descriptors alone."""
    finder = CandidateFinder(encoder.dimensions, encoder.threshold, options)
    accepted: list[LoopCandidate] = []
    for number, descriptor in enumerate(descriptors):
        travelled_m = float(sequence.travelled_m[number])
        no_classes = np.zeros(0, np.int64)
        keyframe = DescribedKeyframe(_EVERY * number, 0, travelled_m, descriptor, no_classes)
        accepted += [c for c in finder.add(keyframe) if c.accepted]
    return accepted


def nearest(
    candidates: Sequence[LoopCandidate], threshold: float, kept: int
) -> list[LoopCandidate]:
    """Those below a threshold, at most so many a query; they come nearest first."""
    chosen: dict[int, list[LoopCandidate]] = {}
    for candidate in candidates:
        mine = chosen.setdefault(candidate.query, [])
        if candidate.distance < threshold and len(mine) < kept:
            mine.append(candidate)
    return [candidate for mine in chosen.values() for candidate in mine]


if __name__ == "__main__":
    main()
