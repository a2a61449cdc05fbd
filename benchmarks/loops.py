"""Loop detection on a walk that comes back: what each test is worth, and each encoder.

    python -m benchmarks.loops ROOMS ... [--image-size 160 120] [--part rows|encoders]

Rooms are made by `semsplat make-room --out ROOMS --layout ring --frames 900 --sensor-noise`, or
`--layout twins --frames 1100`, where two rooms are identical.

The first table runs the system. Without verification each registration that comes to rest enters
the graph and stays there: no bound on it, no odometry to contradict it, no robust kernel.
"Suspected" figures are of the candidates of the search, the others of the loops held at the end.
An edge is false where it puts an anchor more than half a metre from where the truth has it.

The second table describes every fifth frame and searches at each of them for earlier ones, at
true poses: no map is built. Thresholds belong to the encoder, so each stands at its own, at the
adaptive one, and at the one with the best F1 on this very walk, which flatters all alike; the
area under the curve (AUC: how often a true pair is nearer than a false one) needs none.
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

from benchmarks import walks
from benchmarks.machine import describe_machine
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.loops import LoopScore, LoopTruthOptions, true_intervals
from toolkit.evaluation.run_loops import true_views
from toolkit.features.builtin import BuiltinEncoder
from toolkit.features.colour_histogram import ColourHistogramEncoder
from toolkit.features.dinov2 import Dinov2Encoder
from toolkit.features.encoder import Encoder
from toolkit.loops.candidates import (
    CandidateFinder,
    CandidateOptions,
    DescribedKeyframe,
    LoopCandidate,
)
from toolkit.options import validated
from toolkit.runs.settings import RunSettings
from toolkit.slam import Slam

Array = NDArray[np.float64]
Values = dict[str, Any]

# Registrations are believed as they come.
_BELIEVE_ALL: Values = {
    "verification": {
        "least_overlap": 0.0,
        "least_inliers": 0.0,
        "least_class_agreement": 0.0,
        "most_intensity": 1e9,
        "most_depth_m": 1e9,
        "least_information": 0.0,
    },
    "closing": {"least_visible": 0.0, "least_shared": 0.0},
    "pose_graph": {
        "consistency": {"odometry_confidence": 1.0, "pair_confidence": 1.0},
        "retraction": {"confidence": 1.0},
        "solver": {"kernel": "none"},
    },
}
# No class is ever seen so often, and landmarks tell nothing.
_NO_LANDMARKS: Values = {"landmarks": {"least_count": 10**9}}
ROWS: dict[str, Values] = {
    "no loops": {"use": False},
    "descriptor alone": _BELIEVE_ALL | _NO_LANDMARKS,
    "and landmarks as printed (G-7)": _BELIEVE_ALL | {"landmarks": {"weighting": "paper"}},
    "and landmarks, linear": _BELIEVE_ALL | {"landmarks": {"weighting": "linear"}},
    "and landmarks, square root": _BELIEVE_ALL,
    "and verification (default)": {},
}
COLUMNS = (
    "loop_precision_suspected_percent",
    "loop_recall_suspected_percent",
    "loop_f1_suspected_percent",
    "loop_precision_percent",
    "loop_recall_percent",
    "loop_f1_percent",
    "ate_rmse_cm",
    "psnr_db",
    "frames_lost",
    "edges",
    "edges_false",
)

_EVERY = 5  # frames from keyframe to keyframe, for encoders


@dataclass(frozen=True)
class Options:
    """Measure loop detection."""

    rooms: tyro.conf.Positional[tuple[Path, ...]]
    """Data sets, each with its own tables."""
    kind: str = "synthetic"
    """Of the data sets; the truth must be known."""
    image_size: tuple[int, int] | None = None
    """Width and height; native if unset."""
    part: Literal["rows", "encoders", "both"] = "both"
    """Which table."""
    only: tuple[str, ...] = ()
    """Names of rows of the first table; all without it."""
    cover: tuple[int, int] | None = None
    """Frames of the runs, the first and the one after the last, that show nothing."""
    seed: int = 0
    """Of the runs, and of the random weights."""


def main() -> None:
    """Print both tables."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    for room in options.rooms:
        dataset: Dataset = open_dataset(options.kind, room, options.image_size)
        if options.cover is not None:
            dataset = walks.Covered(dataset, *options.cover)
        width, height = dataset.camera.size
        print(f"\n{room.name}, {len(dataset)} frames of {width}x{height}\n", flush=True)
        if options.part != "encoders":
            print_rows(options, room, dataset)
        if options.part != "rows":
            print_encoders(options, dataset)


def print_rows(options: Options, room: Path, dataset: Dataset) -> None:
    """What each test adds, by running the system."""
    print("| | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 1) + "|", flush=True)
    for name, loops in ROWS.items():
        if not options.only or name in options.only:
            run = figures(options, room, dataset, loops)
            cells = [_cell(run.get(column)) for column in COLUMNS]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    print(flush=True)


def figures(options: Options, room: Path, dataset: Dataset, loops: Values) -> Values:
    """Figures of one walk with these settings of loop closure, without refinement."""
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": options.kind, "path": str(room)},
            "image_size": options.image_size,
            "mapping": {"final_iterations": 0},
            "loops": loops,
            "seed": options.seed,
        },
    )
    with walks.walked(settings, dataset) as walk:
        return walk.metrics | {
            "edges": len(walk.slam.loops),
            "edges_false": false_edges(walk.slam, dataset),
        }


def false_edges(slam: Slam, dataset: Dataset) -> int:
    """Loop edges that the truth contradicts."""
    assert dataset.ground_truth is not None
    anchors = [
        dataset.ground_truth.at(dataset[next(iter(slam.atlas.keyframe_poses(n)))].timestamp_s)
        for n in range(len(slam.atlas))
    ]
    count = 0
    for loop in slam.loops:
        T_world_first, T_world_second = anchors[loop.first], anchors[loop.second]
        assert T_world_first is not None and T_world_second is not None
        error = loop.residual(T_world_first, T_world_second)
        count += bool(np.linalg.norm(error[:3]) > LoopTruthOptions().most_distance_m)
    return count


def print_encoders(options: Options, dataset: Dataset) -> None:
    """What each encoder finds by itself."""
    walk = Walk.of(dataset)
    print("| encoder | AUC | threshold | precision_percent | recall_percent | f1_percent |")
    print("|---" * 6 + "|", flush=True)
    with tempfile.TemporaryDirectory() as place:
        for name, encoder in encoders(Path(place), options.seed):
            descriptors = described(dataset, encoder)
            auc = f"{walk.area_under_curve(descriptors):.4f}"
            for threshold, candidates in searches(walk, encoder, descriptors):
                score = walk.score(candidates)
                figures = (score.precision, score.recall, score.f1)
                cells = [_cell(None if f is None else 100.0 * f) for f in figures]
                print(f"| {name} | {auc} | {threshold} | " + " | ".join(cells) + " |", flush=True)


@dataclass(frozen=True)
class Walk:
    """Every fifth frame of a walk.

    Attributes:
        travelled_m: [K] length of the true path up to each.
        truth: [K, K] which pairs (later, earlier) are a true loop.
        beyond: [K, K] which are far enough apart along the path to be asked about.
    """

    travelled_m: Array
    truth: NDArray[np.bool_]
    beyond: NDArray[np.bool_]

    @classmethod
    def of(cls, dataset: Dataset) -> Walk:
        views = true_views(dataset)
        positions_m = views.T_world_camera[:, :3, 3]
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0, prepend=positions_m[:1]), axis=1)
        frames = np.arange(0, len(views), _EVERY)
        anywhere = LoopTruthOptions(most_distance_m=np.inf, least_overlap=0.0)
        pairs = np.ix_(frames, frames)
        return cls(
            np.cumsum(steps_m)[frames],
            true_intervals(views)[pairs],
            true_intervals(views, anywhere)[pairs],
        )

    def score(self, candidates: Sequence[LoopCandidate]) -> LoopScore:
        """Of accepted candidates, all keyframes having been searched at."""
        pairs = [(c.query // _EVERY, c.match // _EVERY) for c in candidates]
        right = [pair for pair in pairs if self.truth[pair]]
        return LoopScore(
            accepted=len(pairs),
            right=len(right),
            searched=len(self.truth),
            with_loop=int(self.truth.any(axis=1).sum()),
            found=len({query for query, _ in right}),
            true_intervals=int(self.truth.sum()),
            found_intervals=len(right),
        )

    def area_under_curve(self, descriptors: NDArray[np.float32]) -> float:
        """How often a pair that is a true loop is nearer than one that is none."""
        distances = np.linalg.norm(descriptors[:, None] - descriptors[None], axis=2)[self.beyond]
        true = self.truth[self.beyond]
        near, far = int(true.sum()), int((~true).sum())
        ranks = rankdata(distances)[true].sum() - near * (near + 1) / 2
        return float(1.0 - ranks / (near * far))


def encoders(folder: Path, seed: int) -> Iterator[tuple[str, Encoder]]:
    """Encoders with their names; the transformer's random weights go through its real files."""
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
    yield "random ViT-S/14, class token", Dinov2Encoder(folder, "class", device="cpu")
    yield "random ViT-S/14, mean of patches", Dinov2Encoder(folder, "mean", device="cpu")


def described(dataset: Dataset, encoder: Encoder) -> NDArray[np.float32]:
    """Descriptors [K, D] of every fifth frame."""
    rows = []
    for index in range(0, len(dataset), _EVERY):
        image = torch.from_numpy(dataset[index].rgb).permute(2, 0, 1)[None]
        with torch.no_grad():
            rows.append(encoder.describe(image)[0].numpy())
    return np.array(rows)


def searches(
    walk: Walk, encoder: Encoder, descriptors: NDArray[np.float32]
) -> Iterator[tuple[str, list[LoopCandidate]]]:
    """A threshold, and the candidates that it accepts."""
    options = CandidateOptions(search_every=1)
    yield f"own, {encoder.threshold:.3f}", found(walk, encoder, descriptors, options)
    adaptive = replace(options, threshold="adaptive")
    yield "adaptive", found(walk, encoder, descriptors, adaptive)
    everything = replace(options, distance=2.0, kept=options.considered)
    every = found(walk, encoder, descriptors, everything)

    def f1(threshold: float) -> float:
        return walk.score(nearest(every, threshold, options.kept)).f1 or 0.0

    best = max(np.unique([c.distance for c in every if c.distance]) + 1e-9, key=f1)
    yield f"best, {best:.3f}", nearest(every, best, options.kept)


def found(
    walk: Walk, encoder: Encoder, descriptors: NDArray[np.float32], options: CandidateOptions
) -> list[LoopCandidate]:
    """Accepted candidates of the search at every keyframe, by descriptors alone."""
    finder = CandidateFinder(encoder.dimensions, encoder.threshold, options)
    accepted: list[LoopCandidate] = []
    for number, descriptor in enumerate(descriptors):
        travelled_m = float(walk.travelled_m[number])
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


def _cell(value: Any) -> str:
    if value is None:
        return "n/a"
    return str(value) if isinstance(value, int) else f"{value:.4g}"


if __name__ == "__main__":
    main()
