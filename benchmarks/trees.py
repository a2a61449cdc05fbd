"""Does the tree matter? Maps of one scene under trees of the same widths.

    SEMSPLAT_DATA=DATA python -m benchmarks.trees [--table meaning|shapes] [--seeds N]

"meaning": our tree of Replica's classes beside a random and an alphabetical one of the same
widths. "shapes": trees by the rules alone beside trees whose last level was sorted by the shapes
measured in the labelled frames. replica_office0, poses given, every fifth view held back.

All are asked the same questions: the class of each pixel decides, and a coarse query is a node
of **our** tree, whichever tree the map was made with. "kin" is the share of wrong pixels whose
class still belongs to the right group of our tree's third level, void aside.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.machine import describe_machine
from toolkit.evaluation.segmentation import class_iou, confusion
from toolkit.geometry import se3
from toolkit.rendering import DrawOptions, backend, draw_surface
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.taxonomy_building.comparison import alphabetical_taxonomy, random_taxonomy

KIN_LEVEL = 2


@dataclass(frozen=True)
class Options:
    """Compare trees."""

    table: Literal["meaning", "shapes"] = "meaning"
    """What to compare."""
    seeds: int = 1
    """Seeds 0, 1, ... of run and tree; a row each."""


def main() -> None:
    """Print one row a tree and seed, and the mean of each tree."""
    options = tyro.cli(Options)
    ours = shipped_taxonomy("replica")
    levels = [f"coarse query, level {level}" for level in range(ours.depth - 1)]
    columns = ["one-hot channels", "own coarsest level", *levels, "class", "kin"]
    print(describe_machine(), flush=True)
    print("\nmIoU in percent on held-back views\n\n| tree | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, path in trees(options, ours, Path(folder)):
            figures = measured(path, ours, Path(folder), options.seeds)
            for seed, row in enumerate(figures):
                print(f"| {name}, seed {seed} | " + " | ".join(f"{x:.4g}" for x in row) + " |")
            mean = [statistics.mean(column) for column in zip(*figures, strict=True)]
            if len(figures) > 1:
                print(f"| {name}, mean | " + " | ".join(f"{x:.4g}" for x in mean) + " |")
            sys.stdout.flush()


def office() -> list[str]:
    """Options that name the scene."""
    path = Path(os.environ["SEMSPLAT_DATA"]) / "replica_office0"
    return ["--dataset.kind", "replica", "--dataset.path", str(path)]


def trees(options: Options, ours: Taxonomy, folder: Path) -> list[tuple[str, Path]]:
    """Names and files; "{seed}" stands in the name of a file that each seed has of its own."""
    if options.table == "meaning":
        made = {
            "ours": ours,
            "random": random_taxonomy(ours),
            "alphabetical": alphabetical_taxonomy(ours),
        }
        for name, taxonomy in made.items():
            taxonomy.save(folder / f"{name}.yaml")
        return [(name, folder / f"{name}.yaml") for name in made]
    for seed in range(options.seeds):
        for name, more in (("rules", []), ("shapes", ["--shapes", "scans"])):
            out = folder / f"{name}{seed}.yaml"
            semsplat("build-taxonomy", *office(), *more, "--seed", str(seed), "--out", str(out))
    return [
        ("rules alone", folder / "rules{seed}.yaml"),
        ("shape-aware", folder / "shapes{seed}.yaml"),
    ]


def measured(path: Path, ours: Taxonomy, folder: Path, seeds: int) -> list[list[float]]:
    """The figures of a tree, seed by seed."""
    rows = []
    for seed in range(seeds):
        tree = Path(str(path).format(seed=seed))
        out = folder / f"run_{tree.stem}_{seed}"
        given = ["--poses", "given", "--hold-out", "5", "--seed", str(seed)]
        semsplat("run", *office(), *given, "--semantics.taxonomy", str(tree), "--out", str(out))
        rows.append(figures_of(load_run(out), ours))
    return rows


def semsplat(*arguments: str) -> None:
    """One program, which must succeed."""
    command = [sys.executable, "-m", "toolkit.cli.main", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")


def figures_of(run: FinishedRun, ours: Taxonomy) -> list[float]:
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
        drawn = draw_surface(
            backend("auto"),
            run.gaussians,
            frame.camera,
            se3.inverse(view.T_map_camera),
            DrawOptions(features=True),
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
