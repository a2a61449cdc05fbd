"""What semantics cost and how accurate labels are, code by code.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics quality [room noise ablation cost] [--seeds 3]

Each part is a table in a file of results of its own. Each run is a process of its own with default
settings except for what its row names.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import RECORDINGS, sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import run_metrics
from benchmarks.semantics_cost import measure_cost
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.slam.mapping.consensus import connected_segments

PartName = Literal["quality", "room", "noise", "ablation", "cost"]
CODES = ("none", "flat", "one-hot", "binary")
GEOMETRY = (
    "images.mapped.psnr_db",
    "images.unseen.psnr_db",
    "images.mapped.ssim",
    "depth.mapped.l1_cm",
)
LABELS = (
    "semantics.mapped.miou_percent",
    "semantics.unseen.miou_percent",
    "semantics.mapped.level_0.miou_percent",
    "semantics.mapped.ece_percent",
)
SUBSET = (
    "semantics.mapped.miou_visible_percent",
    "semantics.mapped.miou_subset_percent",
    "semantics.unseen.miou_subset_percent",
)
TIMES = (
    "time.tracking_ms_per_frame",
    "time.labelling_ms_per_frame",
    "time.mapping_ms_per_frame",
    "time.refinement_ms_per_frame",
)
MEMORY = ("memory.map_mb", "memory.peak_mb")
WRONG_SHARE = 0.2  # of the segments of each frame
WRONG_LABELS = "WRONG_LABELS"  # stands in a job for the folder of the changed labels

OFFICE_TEXT = """\
`semsplat run` on Replica office0 (600x340) with `--poses given --hold-out 5`: every fifth view is
kept out of the map and is an unseen view. The tree is the shipped one of Replica's 101 classes
(5 levels)."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure semantics."""

    parts: tyro.conf.Positional[tuple[PartName, ...]] = ("quality",)
    """Which tables."""
    seeds: int = 1
    """Seeds 0, 1, ...; a row is their median."""
    rounds: int = 15
    """Timed steps of each code, for the part `cost`."""


@dataclass(frozen=True)
class Part:
    """One table.

    Attributes:
        title, description: of the results file.
        columns: metrics.
        rows: a sequence and options of `semsplat run`.
        targets: what the rows should reach, None without targets.
    """

    title: str
    description: str
    columns: tuple[str, ...]
    rows: dict[str, list[str]]
    targets: Callable[[Rows], list[Target]] | None = None


def office(*options: str) -> list[str]:
    """A run on office0 with given poses and held-out views."""
    return ["office0", "--poses", "given", "--hold-out", "5", *options]


def code(kind: str) -> list[str]:
    """Options that choose a code."""
    return ["--semantics.code.kind", kind]


def quality_targets(rows: Rows) -> list[Target]:
    """Accuracy of labels with given poses; codes beside each other."""
    median = median_of(rows)

    def below(row: str, other: str, column: str = "semantics.mapped.miou_percent") -> float | None:
        a, b = median(other, column), median(row, column)
        return None if a is None or b is None else a - b

    one_hot, binary = "one-hot", "binary"
    unseen = "semantics.unseen.miou_percent"
    return [
        Target(
            "one-hot, mIoU of mapped views in %",
            median(one_hot, "semantics.mapped.miou_percent"),
            at_least=97,
        ),
        Target("one-hot, mIoU of unseen views in %", median(one_hot, unseen), at_least=94.5),
        Target("one-hot, coarsest level in %", median(one_hot, LABELS[2]), at_least=99),
        Target("one-hot below flat, mapped, points", below(one_hot, "flat"), at_most=1),
        Target("binary below flat, mapped, points", below(binary, "flat"), at_most=2),
        Target("binary below one-hot, mapped, points", below(binary, one_hot), at_most=1),
        Target("binary below one-hot, unseen, points", below(binary, one_hot, unseen), at_most=1),
        Target(
            "one-hot below none, PSNR in dB",
            below(one_hot, "none", "images.mapped.psnr_db"),
            at_most=0.1,
        ),
    ]


def room_targets(rows: Rows) -> list[Target]:
    """Accuracy of labels on a tracked room."""
    median = median_of(rows)

    def lost(row: str, column: str) -> float | None:
        mapped, unseen = median(row, "semantics.mapped.miou_percent"), median(row, column)
        return None if mapped is None or unseen is None else mapped - unseen

    targets = []
    for row, bound in (("one-hot", 95), ("binary", 93)):
        mapped = median(row, "semantics.mapped.miou_percent")
        refined, unrefined = (
            lost(row, f"semantics.{views}.miou_percent") for views in ("unseen_refined", "unseen")
        )
        targets += [
            Target(f"{row}, mIoU of mapped views in %", mapped, at_least=bound),
            Target(f"{row}, less on unseen views, poses refined, points", refined, at_most=3),
            Target(f"{row}, less on unseen views, true poses, points", unrefined, at_most=3),
        ]
    return targets


_NETWORK = ["--semantics.network.use"]
_SHARE = ["--mapping.seeding.share", "0.35", "--mapping.seeding.choice"]
_WRONG = [
    *("--segmenter.kind", "images"),
    *("--segmenter.images.folder", WRONG_LABELS),
    *("--segmenter.images.pairing", "number"),
]
PARTS: dict[str, Part] = {
    "quality": Part(
        "Semantic codes, poses given",
        f"{OFFICE_TEXT} Subset mIoU decodes each view among the classes of its own ground truth "
        "(`--evaluation.subset`).",
        (*GEOMETRY, *LABELS, "semantics.unseen.level_0.miou_percent", *SUBSET, *TIMES[2:], *MEMORY),
        {kind: office(*code(kind), "--evaluation.subset") for kind in (*CODES, "colour")},
        quality_targets,
    ),
    "room": Part(
        "Semantic codes, tracked",
        "`semsplat run` on the synthetic room (`semsplat make-room`, 300 frames of 320x240), "
        "tracked and mapped. Unseen views lie off the path; refined ones have their poses refined "
        "on the map.",
        (
            "trajectory.ate_rmse_cm",
            *GEOMETRY,
            *LABELS,
            "semantics.unseen_refined.miou_percent",
            "semantics.mapped.classes",
            *TIMES,
            *MEMORY,
        ),
        {kind: ["room", *code(kind)] for kind in CODES},
        room_targets,
    ),
    "noise": Part(
        "Wrong labels",
        f"{OFFICE_TEXT} Rows '20 % wrong': {100 * WRONG_SHARE:.0f} % of the segments of each frame "
        "have another class of the sequence. The row without segment consensus has "
        "`--mapping.consensus.rounds 0`.",
        LABELS,
        {
            "right labels": office(),
            "20 % wrong": office(*_WRONG),
            "20 % wrong, without segment consensus": office(
                *_WRONG, "--mapping.consensus.rounds", "0"
            ),
            "20 % wrong, binary": office(*_WRONG, *code("binary")),
        },
    ),
    "ablation": Part(
        "Semantic loss, decoding and seeding",
        f"{OFFICE_TEXT} Code: one-hot.",
        ("images.mapped.psnr_db", "images.unseen.psnr_db", *LABELS, "map.gaussians", *TIMES[2:]),
        {
            "default: intra-level loss, decoded by path": office(),
            "intra + inter, decoded by path": office(*_NETWORK),
            "intra + inter, decoded by network": office(*_NETWORK, "--semantics.reader", "network"),
            "geometry moved by semantics": office("--semantics.loss.moves-geometry"),
            "35 % of pixels seed, uniform": office(*_SHARE, "uniform"),
            "35 % of pixels seed, by class": office(*_SHARE, "semantic"),
        },
    ),
}


def main() -> None:
    """Measure the parts that were asked for."""
    options = tyro.cli(Options)
    for name in options.parts:
        if name == "cost":
            measure_cost(options.rounds, options.out)
        else:
            measure_part(name, PARTS[name], options)


def measure_part(name: str, part: Part, options: Options) -> None:
    """Measure one table."""
    report = Report(
        f"semantics-{name}", part.title, part.description, options, range(options.seeds)
    )
    with wrong_labels() as folder:

        def measure(job: list[str], seed: int) -> Metrics:
            sequence, *arguments = [str(folder()) if a == WRONG_LABELS else a for a in job]
            return run_metrics([*sequence_arguments(sequence), *arguments], seed)

        rows = report.measured(part.rows, measure)
    targets = [target_table(part.targets(rows))] if part.targets else []
    report.write(table_of(part.columns, rows), *targets)


@contextmanager
def wrong_labels() -> Iterator[Callable[[], Path]]:
    """A function that writes the changed labels when they are first needed."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)

        def written() -> Path:
            if not (folder / "classes.json").exists():
                write_wrong_labels(folder, np.random.default_rng(0))
            return folder

        yield written


def write_wrong_labels(folder: Path, generator: np.random.Generator) -> None:
    """Write the labels of office0 with a share of each frame's segments changed."""
    source = RECORDINGS["office0"].path / "labels"
    shutil.copy(source / "classes.json", folder)
    files = sorted(source.glob("label*.png"))
    images = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
    present = np.unique(np.concatenate([np.unique(image) for image in images]))
    present = present[present > 0]
    for file, image in zip(files, images, strict=True):
        cv2.imwrite(str(folder / file.name), renamed(image, present, generator))


def renamed(
    labels: NDArray[np.integer], present: NDArray[np.integer], generator: np.random.Generator
) -> NDArray[np.integer]:
    """A label image in which WRONG_SHARE of the segments have another class of the sequence."""
    segments, own = connected_segments(labels)
    wrong = (generator.random(len(own)) < WRONG_SHARE) & (own > 0)
    shift = generator.integers(1, len(present), len(own))
    place = (np.searchsorted(present, own) + shift) % len(present)
    return np.where(wrong, present[place], own)[segments].astype(labels.dtype)


if __name__ == "__main__":
    main()
