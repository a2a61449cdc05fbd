"""Does the semantic tree matter? Maps of one scene under trees of the same widths.

SEMSPLAT_DATA=DATA python -m benchmarks.trees [--table meaning|shapes|room] [--seeds N]
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.baseline_trees import alphabetical_taxonomy, random_taxonomy
from benchmarks.programs import semsplat
from benchmarks.recordings import opened, sequence_arguments
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.scripted_model import ScriptedChat
from benchmarks.tables import Table, median_cell
from toolkit.base.geometry import se3
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.evaluation.segmentation import class_iou, confusion
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.language_model.exchanges import (
    RecordingModel,
    ReplayedModel,
)
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.semantics.taxonomy_building.measured_shapes import (
    LabelledScan,
    ScanShapes,
    labelled_scan,
)
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

KIN_LEVEL = 2
SIZE = ("--image-size", "160", "120")  # of the images of the room
QUALITY = {
    "ATE cm": "trajectory.ate_rmse_cm",
    "depth L1 cm": "depth.mapped.l1_cm",
    "PSNR dB": "images.mapped.psnr_db",
}

DESCRIPTIONS = {
    "meaning": "Our tree of Replica's classes, a random and an alphabetical tree of the same "
    "widths.",
    "shapes": "Trees built by the rules alone, and trees whose last level is sorted by the shapes "
    "measured in the labelled frames (`semsplat build-taxonomy --shapes scans`).",
    "room": "The table H-IX for the synthetic room, tracked and mapped (`semsplat make-room`, 300 "
    "frames, `--image-size 160 120`). Trees of Replica's classes: by the words for size and "
    "function; by the shapes measured in the labelled frames; by both (`--shapes scans`); a random "
    "tree of the widths of the latter; and one replayed from the recording of a scripted language "
    "model of which a tenth of the answers and items are wrong.",
}
COMMON = """\
mIoU in percent on held-out views (`--hold-out 5`), of Replica office0 with given poses unless
stated otherwise; ATE, depth L1 and PSNR are of the whole run, on mapped views. All trees are asked
the same questions: the class of each pixel decides, and a coarse query is a node of **our** tree,
whichever tree the map has. "kin" is the share of wrong pixels whose class belongs to the right
group of our tree's third level, without void."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare trees."""

    table: Literal["meaning", "shapes", "room"] = "meaning"
    """What to compare."""
    seeds: int = 1
    """Seeds 0, 1, ... of run and tree; a row for each."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure one row for each tree and seed, and the mean of each tree."""
    options = tyro.cli(Options)
    header = current_header(range(options.seeds))
    ours = shipped_taxonomy("replica")
    rows: list[tuple[str, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, path in trees(options, ours, Path(folder)):
            found = measured(path, ours, Path(folder), options)
            for seed, values in enumerate(found):
                rows.append((f"{name}, seed {seed}", *(median_cell([value]) for value in values)))
            if len(found) > 1:
                rows.append((f"{name}, mean", *map(mean_cell, zip(*found, strict=True))))
    levels = [f"coarse query, level {level}" for level in range(ours.depth - 1)]
    own = ("one-hot channels", "own coarsest level")
    columns = ("tree", *QUALITY, *own, *levels, "class", "kin")
    description = f"{DESCRIPTIONS[options.table]} {COMMON}"
    title = f"Semantic trees: {options.table}"
    table = Table(columns, tuple(rows))
    publish(Results(f"trees-{options.table}", title, description, header, (table,)), options.out)


def mean_cell(values: Sequence[float | None]) -> str:
    """The mean of a column; n/a if a value is missing."""
    known = [value for value in values if value is not None]
    return median_cell([statistics.mean(known) if len(known) == len(values) else None])


def trees(options: Options, ours: Taxonomy, folder: Path) -> list[tuple[str, Path]]:
    """Names and files; "{seed}" stands in the name of a file that each seed has of its own."""
    if options.table != "shapes":
        made = {
            "ours": ours,
            "random": random_taxonomy(ours),
            "alphabetical": alphabetical_taxonomy(ours),
        }
        if options.table == "room":
            made = trees_of_room(ours.classes, folder)
        for name, taxonomy in made.items():
            taxonomy.save(folder / f"{name}.yaml")
        return [(name, folder / f"{name}.yaml") for name in made]
    for seed in range(options.seeds):
        for name, more in (("rules", []), ("shapes", ["--shapes", "scans"])):
            out = folder / f"{name}{seed}.yaml"
            semsplat(
                "build-taxonomy",
                *sequence_arguments("office0"),
                *more,
                "--seed",
                str(seed),
                "--out",
                str(out),
            )
    return [
        ("rules alone", folder / "rules{seed}.yaml"),
        ("shape-aware", folder / "shapes{seed}.yaml"),
    ]


def trees_of_room(classes: Sequence[str], folder: Path) -> dict[str, Taxonomy]:
    """The trees of the table H-IX.

    Raises:
        SystemExit: the replayed tree is not the recorded one.
    """
    rules, shapes = RuleGrouper(), ScanShapes([scan_of_room()])
    meaning = BuildOptions(aspects=("size", "function", "function", "function"))
    shape = BuildOptions(aspects=("geometry",) * 4)
    both = build_taxonomy(classes, rules, shapes)
    record = folder / "record.json"
    model = RecordingModel(ScriptedChat(), record)
    recorded = build_taxonomy(classes, LanguageModelGrouper(model), shapes)
    replayed = build_taxonomy(classes, LanguageModelGrouper(ReplayedModel(record)), shapes)
    if replayed != recorded:
        raise SystemExit("the replayed tree is not the recorded one")
    return {
        "meaning": build_taxonomy(classes, rules, options=meaning),
        "shape": build_taxonomy(classes, rules, shapes, shape),
        "both": both,
        "random": random_taxonomy(both),
        "replayed model": replayed,
    }


def scan_of_room() -> LabelledScan:
    """The labelled points of every sixth frame of the room."""
    dataset = opened("room")
    truth, names = dataset.ground_truth, dataset.label_names
    assert truth is not None
    assert names is not None
    frames = [dataset[index] for index in range(0, len(dataset), 6)]
    posed = [(frame, truth.at(frame.timestamp_s)) for frame in frames]
    return labelled_scan([(frame, T) for frame, T in posed if T is not None], names)


def measured(
    path: Path, ours: Taxonomy, folder: Path, options: Options
) -> list[list[float | None]]:
    """The figures of a tree, seed by seed."""
    tracked = options.table == "room"
    source = [*sequence_arguments("room"), *SIZE] if tracked else sequence_arguments("office0")
    poses = [] if tracked else ["--poses", "given"]
    rows: list[list[float | None]] = []
    for seed in range(options.seeds):
        tree = Path(str(path).format(seed=seed))
        out = folder / f"run_{tree.stem}_{seed}"
        semsplat(
            "run",
            *source,
            *poses,
            *("--hold-out", "5", "--seed", str(seed)),
            "--semantics.taxonomy",
            str(tree),
            "--out",
            str(out),
        )
        metrics = flattened(read_metrics(out / "metrics.json"))
        quality = [metrics.get(name) for name in QUALITY.values()]
        rows.append([*quality, *tree_metrics(load_run(out), ours)])
    return rows


def tree_metrics(run: FinishedRun, ours: Taxonomy) -> list[float]:
    """One row: channels, own coarsest level, our levels, classes, kin."""
    assert run.taxonomy is not None
    dataset = run.open_dataset()
    names = dataset.label_names
    assert names is not None
    truth_to_ours = ours.relabelling(names)
    own_to_ours = ours.relabelling(dict(enumerate(run.taxonomy.classes, start=1)))
    leaves = np.zeros((len(ours) + 1,) * 2, np.int64)
    for view in run.tracked:
        frame = dataset[view.index]
        if not view.held_out or frame.labels is None:
            continue
        drawn = render_surface(
            backend("auto"),
            run.gaussians,
            frame.camera,
            se3.inverse(view.T_map_camera),
            RenderOptions(features=True),
        )
        decoded = run.semantics.decode_view(drawn).class_ids.reshape(frame.labels.shape)
        leaves += confusion(truth_to_ours[frame.labels], own_to_ours[decoded], len(ours))
    groups = [grouping(ours, level) for level in range(ours.depth)]
    levels = [miou_percent(leaves, group) for group in groups]
    own = grouping(run.taxonomy, 0)[np.argsort(own_to_ours)]
    widths = sum(run.taxonomy.level_widths)
    return [widths, miou_percent(leaves, own), *levels, kin_percent(leaves, groups[KIN_LEVEL])]


def grouping(taxonomy: Taxonomy, level: int) -> NDArray[np.int64]:
    """The number [C + 1] of each class's node at a level, from 1 on; 0 is void."""
    _, place = np.unique(taxonomy.node_ids[:, level], return_inverse=True)
    return np.concatenate([[0], 1 + place])


def miou_percent(leaves: NDArray[np.int64], group: NDArray[np.int64]) -> float:
    """Mean IoU of the groups that the truth has, from the confusion of classes."""
    count = int(group.max()) + 1
    coarse = np.zeros((count, count), np.int64)
    np.add.at(coarse, (group[:, None], group[None, :]), leaves)
    present = coarse.sum(axis=1) > 0
    present[0] = False
    return 100.0 * float(np.mean(class_iou(coarse)[present]))


def kin_percent(leaves: NDArray[np.int64], group: NDArray[np.int64]) -> float:
    """Of the wrong pixels, those whose class is of the truth's group."""
    wrong = leaves[1:, 1:] - np.diag(np.diag(leaves)[1:])
    same = group[1:, None] == group[None, 1:]
    return 100.0 * float(wrong[same].sum() / max(wrong.sum(), 1))


if __name__ == "__main__":
    main()
